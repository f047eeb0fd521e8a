"""Compare recovered cameras and clocks with the ground truth of a simulated session.

A reconstruction's frame and scale are its own, so one similarity, fitted on all camera centres (sweep and
fixed cameras), takes the recovered world into the true one; what is left is error. Clocks need no fit:
both are on the first camera's clock.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from devrf.calibration.clocks.equations import Clock
from devrf.capture.camera import Camera
from devrf.capture.system.arrays import ArrayError, read_npz
from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import TEXT_BYTES, check_bytes

FEWEST_CENTRES = 3  # a similarity needs three points that are not on one line
COLLINEAR = 1e-6  # second extent over first; below, the turn about the line is free
ROUNDED = 1e-2  # |R R^T - I|; a truth may be written with a few digits
FARTHEST_M = 1e5  # of a camera from the origin
LARGEST_OFFSET_S, LARGEST_DRIFT_PPM = 1e10, 1e5  # times since 1970 have ten digits

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Truth:
    """Ground truth of a session.

    Attributes:
        static: world_from_camera of the sweep's frames, by frame index.
        cameras: world_from_camera of the fixed cameras, by name.
        clocks: Their clocks, by name.
    """

    static: Mapping[int, Pose]
    cameras: Mapping[str, Pose]
    clocks: Mapping[str, Clock]


def read_truth(path: Path) -> Truth:
    """Read ground_truth.json (docs/formats.md).

    Raises:
        InputError: Not such a file.
    """
    try:
        check_bytes(path, TEXT_BYTES)
        data = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(data, dict):
            raise ValueError(f"it holds a {type(data).__name__}")
        static = {n: _pose(pose) for n, pose in enumerate(data.get("static") or [])}
        cams = data.get("cams") or {}
        return Truth(
            static=static,
            cameras={name: _pose(cam["pose"]) for name, cam in cams.items()},
            clocks={
                name: _clock(float(cam["offset_s"]), float(cam.get("drift_ppm", 0.0)))
                for name, cam in cams.items()
                if cam.get("offset_s") is not None
            },
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        expected = "expected static and cams with world_from_camera poses, see evaluate.truth"
        why = str(error) if isinstance(error, ValueError) else repr(error)
        raise InputError("file-damaged", f"{path}: not a ground truth ({why}); {expected}") from error


def read_masks(
    path: Path, cameras: Mapping[str, tuple[int, int, int]]
) -> dict[str, Bool[np.ndarray, "frames h w"]]:
    """What moves in truth in cameras' pictures, where that is known.

    Args:
        path: The ground truth; masks lie beside it, `<camera>_mask.npz`, with the array `mask` in the clip's order.
            Where there is one camera, it may be called `witness_mask.npz`.
        cameras: By name: fewest pictures that the clip has, and their height and width.
    Raises:
        ArrayError: A file is damaged, or holds something else.
    """
    found = {}
    for name, (count, height, width) in cameras.items():
        files = [path.with_name(f"{name}_mask.npz")]
        if len(cameras) == 1:
            files.append(path.with_name("witness_mask.npz"))
        file = next((file for file in files if file.is_file()), None)
        if file is not None:
            mask = read_npz(file, ("mask",))["mask"]
            if mask.ndim != 3 or len(mask) < count or mask.shape[1:] != (height, width):
                text = f"{file}: mask has shape {list(mask.shape)}; expected [{count} or more, {height}, {width}]"
                wrong = f"{text}: one for every picture of {name}'s clip, at its size"
                raise ArrayError("mask-size-wrong", wrong)
            found[name] = mask.astype(bool)
    return found


def compare_cameras(
    truth: Truth,
    static: Mapping[int, Camera],
    cameras: Mapping[str, Camera],
    scene_centre: Float[np.ndarray, "3"],
) -> dict[str, float | None]:
    """Pose errors after one similarity; the largest and the median over the sweep and over the fixed cameras.

    Args:
        truth: The truth.
        static: Recovered sweep cameras by frame index.
        cameras: Recovered fixed cameras by name.
        scene_centre: Of the recovered world [3]; distances for `rig_position_percent` go to it.
    Returns:
        `pose_rotation_deg`, `pose_position_m` (sweep), `rig_rotation_deg`, `rig_position_m`,
        `rig_position_percent` (fixed cameras; of the true distance to the scene's centre), each with its
        `_median`; `scale`, true over recovered length. None where it cannot be computed.
    """
    frames = [(truth.static[n], camera) for n, camera in static.items() if n in truth.static]
    fixed = [(truth.cameras[n], camera) for n, camera in cameras.items() if n in truth.cameras]
    pairs = frames + fixed
    names = ("pose_rotation_deg", "pose_position_m")
    rig_names = ("rig_rotation_deg", "rig_position_m", "rig_position_percent")
    empty: dict[str, float | None] = {f"{n}{s}": None for n in (*names, *rig_names) for s in ("", "_median")}
    empty["scale"] = None
    true_centres = np.array([pose[:3, 3] for pose, _ in pairs]).reshape(-1, 3)
    centres = np.array([camera.centre for _, camera in pairs]).reshape(-1, 3)
    if len(pairs) < FEWEST_CENTRES or _is_line(centres) or _is_line(true_centres):
        return empty
    true_from_world = similarity(centres, true_centres)
    scale = float(np.cbrt(np.linalg.det(true_from_world[:3, :3])))
    turn = true_from_world[:3, :3] / scale
    position = np.linalg.norm(
        centres @ true_from_world[:3, :3].T + true_from_world[:3, 3] - true_centres, axis=1
    )
    rotation = np.array(
        [rotation_angle_deg(turn @ c.cam_from_world[:, :3].T, pose[:3, :3]) for pose, c in pairs]
    )
    true_scene = true_from_world[:3, :3] @ scene_centre + true_from_world[:3, 3]
    percent = 100 * position / np.linalg.norm(true_centres - true_scene, axis=1)
    n = len(frames)
    out = dict(empty)
    out["scale"] = scale
    for name, values in zip(
        (*names, *rig_names),
        (rotation[:n], position[:n], rotation[n:], position[n:], percent[n:]),
        strict=True,
    ):
        if len(values):
            out[name], out[f"{name}_median"] = float(values.max()), float(np.median(values))
    return out


def compare_clocks(
    truth: Truth, clocks: Mapping[str, Clock], spans_s: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Largest error of each camera's true time over the span that all clips share, milliseconds.

    Args:
        truth: The truth; its clocks are taken relative to those of the first camera of `clocks`.
        clocks: Recovered clocks by name; the first one is the reference.
        spans_s: First and last file time of each clip.
    Returns:
        Milliseconds by camera, for cameras in all three; empty where the clips share nothing.
    """
    known = [n for n in clocks if n in truth.clocks and n in spans_s]
    reference = next(iter(clocks), None)
    if not known or reference is None or reference not in truth.clocks:
        return {}
    zero = truth.clocks[reference]

    def true_on_reference(name: str, file_time_s: float) -> float:
        return zero.file_time(truth.clocks[name].true_time(file_time_s))

    begin = max(true_on_reference(n, spans_s[n][0]) for n in known)
    end = min(true_on_reference(n, spans_s[n][1]) for n in known)
    if not begin < end:
        return {}
    out = {}
    for name in known:
        # both are straight lines, so the largest difference lies at an end
        files = [truth.clocks[name].file_time(zero.true_time(t)) for t in (begin, end)]
        errors = [abs(clocks[name].true_time(f) - true_on_reference(name, f)) for f in files]
        out[name] = 1e3 * max(errors)
    return out


def similarity(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Pose:
    """target_from_source [4, 4]: scale, rotation, translation of least squares (Umeyama, PAMI 1991)."""
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t.T @ s / len(s))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ np.diag(sign) @ Vt
    scale = (D * sign).sum() / (s**2).sum(1).mean()
    out = np.eye(4)
    out[:3, :3] = scale * R
    out[:3, 3] = mean_t - scale * R @ mean_s
    return out


def rotation_angle_deg(a: Float[np.ndarray, "3 3"], b: Float[np.ndarray, "3 3"]) -> float:
    """Angle between two rotations, degrees; exact for small angles too."""
    chord = np.linalg.norm(a - b) / np.sqrt(8)  # sin(angle / 2)
    return float(np.degrees(2 * np.arcsin(min(chord, 1.0))))


def _pose(value: object) -> Pose:
    pose = np.array(value, dtype=np.float64)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise ValueError(f"a pose has shape {pose.shape}, expected 4 x 4 finite numbers")
    R, farthest_m = np.clip(pose[:3, :3], -2, 2), np.abs(pose[:3, 3]).max()
    if np.abs(R @ R.T - np.eye(3)).max() > ROUNDED or farthest_m > FARTHEST_M:
        text = f"a pose has the rotation {pose[:3, :3].tolist()} and is {farthest_m:g} m away"
        raise ValueError(f"{text}, expected an orthonormal matrix and at most {FARTHEST_M:g} m")
    return np.vstack([pose[:3], [0, 0, 0, 1.0]])


def _clock(offset_s: float, drift_ppm: float) -> Clock:
    if not (abs(offset_s) <= LARGEST_OFFSET_S and abs(drift_ppm) <= LARGEST_DRIFT_PPM):
        text = f"a clock has offset_s {offset_s:g} and drift_ppm {drift_ppm:g}"
        raise ValueError(f"{text}, expected at most {LARGEST_OFFSET_S:g} and {LARGEST_DRIFT_PPM:g}")
    return Clock(offset_s, drift_ppm)


def _is_line(points: Float[np.ndarray, "n 3"]) -> bool:
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(extent[1] <= COLLINEAR * extent[0])
