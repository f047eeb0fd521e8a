"""Read the 3D points of a COLMAP model (`points3D.bin`), without COLMAP.

Layout (COLMAP documentation, "Output format"): a uint64 count, then for each point uint64 id, three
float64 coordinates, three uint8 colours, float64 reprojection error, uint64 track length and that many
pairs of uint32 (picture, keypoint). Little endian. Coordinates are in the model's own world frame.
"""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.errors import CaptureError

_COUNT = struct.Struct("<Q")
_HEAD = struct.Struct("<QdddBBBdQ")
_TRACK_ELEMENT = 8  # bytes: two uint32


def read_colmap_points(folder: Path) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Read positions and colours of a COLMAP model's points.

    Args:
        folder: Folder that holds `points3D.bin`.
    Returns:
        xyz [N, 3] in the model's frame and units; rgb [N, 3] in [0, 255].
    Raises:
        CaptureError: If the file is missing or ends too early.
    """
    path = folder / "points3D.bin"
    try:
        data = path.read_bytes()
    except OSError as error:
        text = f"{path}: cannot be read ({error.strerror}); run the stage static_poses"
        raise CaptureError("file-unreadable", text) from error
    try:
        (count,) = _COUNT.unpack_from(data)
        return _unpack_points(data, count)
    except struct.error as error:
        wrong = f"{path}: {len(data)} bytes are fewer than its header promises, the file was cut off"
        raise CaptureError("file-damaged", f"{wrong}; run with --force static_poses") from error


def _unpack_points(data: bytes, count: int) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    if count > len(data) // _HEAD.size:  # a damaged count must not allocate gigabytes
        raise struct.error("more points than bytes")
    xyz, rgb = np.empty((count, 3)), np.empty((count, 3), dtype=np.uint8)
    offset = _COUNT.size
    for n in range(count):
        _, x, y, z, red, green, blue, _, track = _HEAD.unpack_from(data, offset)
        xyz[n], rgb[n] = (x, y, z), (red, green, blue)
        offset += _HEAD.size + _TRACK_ELEMENT * track
    if offset > len(data):
        raise struct.error("last track is cut off")
    return xyz, rgb
