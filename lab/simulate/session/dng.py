"""RAW files with known content: a writer of uncompressed DNG (Adobe, Digital Negative Specification 1.4)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

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


@dataclass(frozen=True)
class DngTags:
    """What a DNG's tags say.

    Attributes:
        pattern: Colours of the top-left 2 x 2 pixels, row by row.
        black: Black level by place in the pattern.
        white: White level.
        neutral: What the sensor records of white: one over the white balance as shot.
        orientation: EXIF's number.
        exposure_s: Shutter time.
    """

    pattern: str = "RGGB"
    black: tuple[int, int, int, int] = (0, 0, 0, 0)
    white: int = 65535
    neutral: tuple[float, float, float] = (1.0, 1.0, 1.0)
    orientation: int = 1
    exposure_s: float = 0.01


def write_dng(path: Path, raw: Int[np.ndarray, "h w"], shot: DngTags) -> None:
    """Write sensor values of 16 bits as a DNG."""
    height, width = raw.shape
    pixels = raw.astype("<u2").tobytes()
    tags = ImageFileDirectory_v2()  # finds types and places by itself
    tags.update(
        {
            254: 0,  # the picture in full
            256: width,
            257: height,
            258: 16,
            259: 1,  # not compressed
            262: 32803,  # colour filter array
            271: "devrf",
            272: "test",
            273: 0,  # pixels: right behind all directories
            274: shot.orientation,
            277: 1,
            278: height,
            279: len(pixels),
            284: 1,
            33421: (2, 2),
            33422: bytes(CHANNEL[c] for c in shot.pattern),
            34665: {33434: IFDRational(shot.exposure_s), 33437: IFDRational(4.0), 34855: 100},  # EXIF
            50706: bytes((1, 4, 0, 0)),
            50707: bytes((1, 1, 0, 0)),
            50708: "devrf test",
            50713: (2, 2),
            50714: shot.black,
            50717: shot.white,
            50721: tuple(IFDRational(round(1e4 * v), 10_000) for v in SRGB_FROM_XYZ.ravel().tolist()),
            50728: tuple(IFDRational(v) for v in shot.neutral),
            50778: 21,  # the matrix is for D65
        }
    )
    with path.open("wb") as file:
        tags.save(file)
        file.write(pixels)
