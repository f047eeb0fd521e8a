"""Rigs and frames of COLMAP's models (since COLMAP 3.12): `rigs.bin` and `frames.bin` beside the model.

A rig is a set of cameras that keep their places to one another, each with a pose in the rig; a frame is a moment of
the rig, with its pose in the world and the pictures taken then. Layout, little endian (COLMAP, "Output format"):
- rigs: uint64 count; each uint32 id, uint32 number of sensors, the reference sensor as int32 type (0: camera) and
  uint32 id, then each other sensor as int32 type, uint32 id, uint8 whether a pose follows, sensor_from_rig as float64
  qw qx qy qz tx ty tz
- frames: uint64 count; each uint32 id, uint32 rig, rig_from_world as above, uint32 number of pictures, each int32
  type, uint32 camera, uint64 image
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.capture.formats.colmap.colmap_model import Model
from devrf.capture.formats.colmap.colmap_poses import pose, quat_wxyz

CAMERA = 0  # type of a sensor
STILL = 1e-6  # how far a fixed camera's poses may differ, by rounding


@dataclass(frozen=True)
class ModelRig:
    """A rig: its reference camera, and where the others are (cam_from_rig [3, 4]), by the cameras' ids."""

    reference: int
    others: dict[int, Float[np.ndarray, "3 4"]]


@dataclass(frozen=True)
class ModelFrame:
    """A moment of a rig: rig_from_world [3, 4], and the camera of each image."""

    rig: int
    rig_from_world: Float[np.ndarray, "3 4"]
    images: dict[int, int]


def own_rigs(model: Model) -> tuple[dict[int, ModelRig], dict[int, ModelFrame]]:
    """Every camera a rig by itself, every image a frame, as COLMAP takes models without rigs."""
    rigs = {number: ModelRig(number, {}) for number in model.cameras}
    frames = {
        number: ModelFrame(image.camera_id, pose(image, image.name), {number: image.camera_id})
        for number, image in model.images.items()
    }
    return rigs, frames


def common_rig(
    model: Model, groups: Sequence[Sequence[int]]
) -> tuple[dict[int, ModelRig], dict[int, ModelFrame]]:
    """All cameras as one rig, a frame for each group of images; as `own_rigs` where a camera moves or changes.

    Args:
        model: Its cameras are told apart by id.
        groups: Ids of the images, those of a frame together, of a camera at most one in each.
    """
    poses: dict[int, Float[np.ndarray, "3 4"]] = {}
    for image in model.images.values():
        here = pose(image, image.name)
        if np.abs(poses.setdefault(image.camera_id, here) - here).max() > STILL:
            return own_rigs(model)
    if any(len({model.images[n].camera_id for n in group}) < len(group) for group in groups):
        return own_rigs(model)
    first = min(poses)
    world_from_rig = np.linalg.inv(np.vstack([poses[first], [0, 0, 0, 1.0]]))
    rig = ModelRig(first, {number: T @ world_from_rig for number, T in poses.items() if number != first})
    frames = {
        n + 1: ModelFrame(1, poses[first], {image: model.images[image].camera_id for image in group})
        for n, group in enumerate(groups)
    }
    return {1: rig}, frames


def simultaneous(pictures: Sequence[tuple[str, float]]) -> list[list[int]]:
    """Numbers of the pictures that were taken at about the same time, of each camera at most one in a group.

    Cameras run free: each picture goes to the nearest of the camera that has most, where it lies within half of the
    step between that camera's pictures; what is left over is a group by itself.

    Args:
        pictures: Camera and time in seconds of each.
    """
    of: dict[str, list[int]] = {}
    for n in sorted(range(len(pictures)), key=lambda n: pictures[n][1]):
        of.setdefault(pictures[n][0], []).append(n)
    lead = max(of, key=lambda camera: len(of[camera]))
    ticks = np.array([pictures[n][1] for n in of[lead]])
    reach = 0.5 * float(np.median(np.diff(ticks))) if len(ticks) > 1 else np.inf
    groups, rest = [[n] for n in of.pop(lead)], []
    for clip in of.values():
        taken: dict[int, int] = {}
        for n in sorted(clip, key=lambda n: np.abs(ticks - pictures[n][1]).min()):
            tick = int(np.abs(ticks - pictures[n][1]).argmin())
            near = abs(ticks[tick] - pictures[n][1]) <= reach and tick not in taken
            (groups[tick] if near else rest).append(n)
            taken.setdefault(tick, n)
    return groups + [[n] for n in sorted(rest)]


def write_rigs(folder: Path, rigs: dict[int, ModelRig], frames: dict[int, ModelFrame]) -> None:
    """Write both files into the folder of a model."""
    rows = [struct.pack("<Q", len(rigs))]
    for number, rig in rigs.items():
        rows.append(struct.pack("<IIiI", number, 1 + len(rig.others), CAMERA, rig.reference))
        rows += [struct.pack("<iIB", CAMERA, n, 1) + _packed(T) for n, T in rig.others.items()]
    (folder / "rigs.bin").write_bytes(b"".join(rows))
    rows = [struct.pack("<Q", len(frames))]
    for number, frame in frames.items():
        rows.append(struct.pack("<II", number, frame.rig) + _packed(frame.rig_from_world))
        rows.append(struct.pack("<I", len(frame.images)))
        rows += [struct.pack("<iIQ", CAMERA, camera, image) for image, camera in frame.images.items()]
    (folder / "frames.bin").write_bytes(b"".join(rows))


def _packed(transform: Float[np.ndarray, "3 4"]) -> bytes:
    return struct.pack("<7d", *quat_wxyz(transform[:, :3]), *transform[:, 3])
