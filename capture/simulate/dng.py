"""RAW files with known content: a writer of uncompressed DNG (Adobe, Digital Negative Specification 1.4)."""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10
CHANNEL = {"R": 0, "G": 1, "B": 2}
# CIE XYZ (D65) to linear sRGB (IEC 61966-2-1): a sensor with this matrix records sRGB, so pixels are their own truth.
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])


def mosaic(
    linear: Float[np.ndarray, "h w 3"], pattern: str, black: tuple[int, int, int, int], white: int
) -> Int[np.ndarray, "h w"]:
    """What a sensor with a 2 x 2 pattern such as RGGB records of linear light in [0, 1]; black by place in it."""
    values = np.zeros(linear.shape[:2])
    for k, colour in enumerate(pattern):
        y, x = divmod(k, 2)
        channel = linear[y::2, x::2, CHANNEL[colour]]
        values[y::2, x::2] = black[k] + channel * (white - max(black))
    return np.clip(np.round(values), 0, 65535).astype(np.int64)


def write_dng(
    path: Path,
    raw: Int[np.ndarray, "h w"],
    *,
    pattern: str = "RGGB",
    black: tuple[int, int, int, int] = (0, 0, 0, 0),
    white: int = 65535,
    neutral: tuple[float, float, float] = (1.0, 1.0, 1.0),
    orientation: int = 1,
    exposure_s: float = 0.01,
) -> None:
    """Write sensor values as a DNG.

    Args:
        path: The file.
        raw: Values, 16 bits.
        pattern: Colours of the top-left 2 x 2 pixels, row by row.
        black: Black level by place in the pattern.
        white: White level.
        neutral: What the sensor records of white: one over the white balance as shot.
        orientation: EXIF's number.
        exposure_s: Shutter time.
    """
    height, width = raw.shape
    pixels = raw.astype("<u2").tobytes()

    def rationals(values: np.ndarray) -> bytes:
        return b"".join(struct.pack("<ii", round(1e6 * float(v)), 1_000_000) for v in values)

    exif = [
        (33434, RATIONAL, 1, rationals(np.array([exposure_s]))),
        (33437, RATIONAL, 1, rationals(np.array([4.0]))),
        (34855, SHORT, 1, struct.pack("<H", 100)),
    ]
    main = [
        (254, LONG, 1, struct.pack("<I", 0)),
        (256, LONG, 1, struct.pack("<I", width)),
        (257, LONG, 1, struct.pack("<I", height)),
        (258, SHORT, 1, struct.pack("<H", 16)),
        (259, SHORT, 1, struct.pack("<H", 1)),
        (262, SHORT, 1, struct.pack("<H", 32803)),  # colour filter array
        (271, ASCII, 6, b"devrf\0"),
        (272, ASCII, 5, b"test\0"),
        (273, LONG, 1, b""),  # where the pixels are; below
        (274, SHORT, 1, struct.pack("<H", orientation)),
        (277, SHORT, 1, struct.pack("<H", 1)),
        (278, LONG, 1, struct.pack("<I", height)),
        (279, LONG, 1, struct.pack("<I", len(pixels))),
        (284, SHORT, 1, struct.pack("<H", 1)),
        (33421, SHORT, 2, struct.pack("<HH", 2, 2)),
        (33422, BYTE, 4, bytes(CHANNEL[c] for c in pattern)),
        (34665, LONG, 1, b""),  # where the EXIF directory is; below
        (50706, BYTE, 4, bytes((1, 4, 0, 0))),
        (50707, BYTE, 4, bytes((1, 1, 0, 0))),
        (50708, ASCII, 11, b"devrf test\0"),
        (50713, SHORT, 2, struct.pack("<HH", 2, 2)),
        (50714, LONG, 4, struct.pack("<4I", *black)),
        (50717, LONG, 1, struct.pack("<I", white)),
        (50721, SRATIONAL, 9, rationals(SRGB_FROM_XYZ.ravel())),
        (50728, RATIONAL, 3, rationals(np.array(neutral))),
        (50778, SHORT, 1, struct.pack("<H", 21)),  # the matrix is for D65
    ]
    exif_at = 8
    exif_block = _directory(exif, exif_at)
    main_at = exif_at + len(exif_block)
    pixels_at = main_at + len(_directory(main, main_at))
    places = {273: pixels_at, 34665: exif_at}
    main = [(t, k, n, struct.pack("<I", places[t]) if t in places else v) for t, k, n, v in main]
    path.write_bytes(b"II*\0" + struct.pack("<I", main_at) + exif_block + _directory(main, main_at) + pixels)


def _directory(entries: list[tuple[int, int, int, bytes]], at: int) -> bytes:
    """A TIFF directory that begins at byte `at`, followed by the values that do not fit into it."""
    table = struct.pack("<H", len(entries))
    beyond = b""
    beyond_at = at + 2 + 12 * len(entries) + 4
    for tag, kind, count, value in entries:
        if len(value) <= 4:
            field = value.ljust(4, b"\0")
        else:
            field = struct.pack("<I", beyond_at + len(beyond))
            beyond += value + b"\0" * (len(value) % 2)
        table += struct.pack("<HHI", tag, kind, count) + field
    return table + struct.pack("<I", 0) + beyond
