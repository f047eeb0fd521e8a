"""Flow on disk: a folder per camera, one small npz file per pair of frames, readable without pickle or OpenCV.

`<camera>/<index>.npz` holds the backward flow of frame `index` to the previous used frame of the camera, in pixels of
the training-size picture; the first frame has none. Vectors are whole steps of 1/64 px (so at most 1/128 px off, where
methods err by 0.2), up to 511 px. Neighbours hardly differ, so each row is stored as differences from left to right,
their signs folded into the last bit, low and high bytes apart: that compresses to a byte or two per pixel.
`confidence` is 0 where the flow cannot be trusted, else 1 to 15, as parts of the best weight. `checks` is text (JSON).
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float16, Float32, Int, Int16, UInt8

from devrf.capture.system.arrays import ArrayError, read_npz
from devrf.capture.system.durable import whole
from devrf.capture.system.errors import FlowError

STEPS_PER_PX = 64
FARTHEST_PX = 511.0  # 16 bits of steps
BEST = 15  # confidence


@dataclass(frozen=True)
class CameraFlow:
    """Backward flow of one camera's frames, all to the previous used frame.

    Attributes:
        camera: Name of the camera.
        index: Frame index of each entry [N], rising.
        flow: Vectors [N, height, width, 2]: u right, v down, pixels of the stored size.
        valid: Where the flow can be trusted [N, height, width].
        confidence: How much, 0 (not at all) to 15 [N, height, width]; None: what is valid is so alike.
        agreement: How far the pictures bear each vector out, 0 to 15 [N, height, width]; None: they were not asked.
    """

    camera: str
    index: Int[np.ndarray, " N"]
    flow: Float16[np.ndarray, "N height width 2"]
    valid: Bool[np.ndarray, "N height width"]
    confidence: UInt8[np.ndarray, "N height width"] | None = None
    agreement: UInt8[np.ndarray, "N height width"] | None = None


def pair_path(folder: Path, camera: str, index: int) -> Path:
    """The file of one pair."""
    return folder / camera / f"{index:06d}.npz"


def write_pair(
    path: Path,
    flow: Float32[np.ndarray, "height width 2"],
    confidence: UInt8[np.ndarray, "height width"],
    checks: Mapping[str, Any],
) -> None:
    """Write one pair, whole or not at all; what is too long to be stored is not to be trusted."""
    confidence = np.where((np.abs(flow) < FARTHEST_PX).all(-1), confidence, np.uint8(0))
    steps = np.rint(np.where(confidence[..., None] > 0, flow, 0) * STEPS_PER_PX).astype(np.int16)
    folded = _folded(_carried_on(steps, confidence > 0))
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path, alone=True) as new, new.open("wb") as file:
        np.savez_compressed(
            file,
            low=(folded & 255).astype(np.uint8),
            high=(folded >> 8).astype(np.uint8),
            confidence=confidence,
            checks=np.array(json.dumps(dict(checks))),
        )


def read_pair(path: Path) -> tuple[Float16[np.ndarray, "height width 2"], UInt8[np.ndarray, "height width"]]:
    """Vectors (0 where they cannot be trusted) and confidence of one pair.

    Raises:
        FlowError: A file that is damaged or is not one of ours.
    """
    found = _read(path, "low", "high", "confidence")
    confidence = found["confidence"]
    folded = found["low"] | (found["high"].astype(np.uint16) << 8)
    differences = (folded >> 1).astype(np.int16) ^ -(folded & 1).astype(np.int16)
    steps = np.cumsum(differences, axis=1, dtype=np.int16)
    flow = steps.astype(np.float32) / STEPS_PER_PX
    return np.where(confidence[..., None] > 0, flow, 0).astype(np.float16), confidence


def read_checks(path: Path) -> dict[str, Any]:
    """What was measured of a pair when it was written.

    Raises:
        FlowError: A file that is damaged or is not one of ours.
    """
    return json.loads(str(_read(path, "checks", text=True)["checks"]))


def read_flows(folder: Path) -> dict[str, CameraFlow]:
    """All cameras' flow in `folder`, by camera name.

    Raises:
        FlowError: A file that is damaged or is not one of ours.
    """
    flows = {}
    for camera in sorted(path for path in folder.glob("*") if path.is_dir()):
        paths = sorted(camera.glob("*.npz"), key=lambda path: int(path.stem))
        if not paths:
            continue
        pairs = [read_pair(path) for path in paths]
        confidence = np.stack([c for _, c in pairs])
        index = np.array([int(path.stem) for path in paths], dtype=np.int32)
        flow = np.stack([f for f, _ in pairs])
        flows[camera.name] = CameraFlow(camera.name, index, flow, confidence > 0, confidence)
    return flows


def _read(path: Path, *names: str, text: bool = False) -> dict[str, np.ndarray]:
    try:
        return read_npz(path, names, text=text)
    except ArrayError as error:
        raise FlowError(error.code, f"{error}; run again with --force flow") from error


def _carried_on(
    steps: Int16[np.ndarray, "height width 2"], valid: Bool[np.ndarray, "height width"]
) -> Int16[np.ndarray, "height width 2"]:
    """Where nothing is valid, the last valid vector to the left: no difference, nothing to store."""
    last = np.maximum.accumulate(np.where(valid, np.arange(valid.shape[1]), -1), axis=1)
    found = np.take_along_axis(steps, np.maximum(last, 0)[..., None], axis=1)
    return np.where((last >= 0)[..., None], found, np.int16(0))


def _folded(steps: Int16[np.ndarray, "height width 2"]) -> np.ndarray:
    """Differences along rows, as whole numbers from 0: 0, -1, 1, -2, 2 … become 0, 1, 2, 3, 4 …"""
    differences = np.diff(steps, axis=1, prepend=np.int16(0))  # modulo 2^16, as they are added up again
    return ((differences << 1) ^ (differences >> 15)).view(np.uint16)
