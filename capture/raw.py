"""Develop RAW photos with one fixed recipe, so that equal light gives equal pixels in every picture.

Nothing is adapted to the single picture: no automatic brightness, no automatic maximum, one white balance
(the sensor's daylight multipliers, or the ones given), 16 bits linear inside, then the sRGB curve
(IEC 61966-2-1) to 8 bits. The turn stored by the camera is applied here, once.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from devrf.capture.errors import CaptureError, InputError
from devrf.capture.srgb import srgb_from_linear

RAW_SUFFIXES = frozenset(
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .k25 .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf "
    ".raw .rw2 .rwl .sr2 .srf .srw .x3f".split()
)


@dataclass(frozen=True)
class Development:
    """A developed RAW photo.

    Attributes:
        rgb: Picture [height, width, 3], sRGB, upright.
        white_balance: Multipliers used for R, G, B and the second G.
        clipped: Share of pixels with a channel at white.
    """

    rgb: UInt8[np.ndarray, "height width 3"]
    white_balance: tuple[float, float, float, float]
    clipped: float


def is_raw(path: Path) -> bool:
    """Whether the file name is that of a RAW photo."""
    return path.suffix.lower() in RAW_SUFFIXES


def develop(path: Path, white_balance: tuple[float, float, float, float] | None = None) -> Development:
    """Develop one RAW file.

    Args:
        path: The file.
        white_balance: Multipliers for R, G, B, second G; None: this sensor's daylight multipliers. Give
            the first picture's to all others of a set.
    Raises:
        InputError: If the file is not a RAW file that LibRaw reads.
        CaptureError: If its content is damaged.
    """
    import rawpy

    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path in scene.yaml")
    try:
        file = rawpy.imread(str(path))
    except rawpy.LibRawError as error:
        raise InputError(
            f"{path}: not a RAW file that LibRaw reads ({_reason(error)}); convert it to DNG"
        ) from None
    with file:
        try:
            balance = white_balance or _daylight(file.daylight_whitebalance)
            linear = file.postprocess(
                gamma=(1, 1),
                output_bps=16,
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_wb=list(balance),
                demosaic_algorithm=rawpy.DemosaicAlgorithm.AHD,
                highlight_mode=rawpy.HighlightMode.Clip,
                output_color=rawpy.ColorSpace.sRGB,
            )
        except rawpy.LibRawError as error:
            raise CaptureError(f"{path}: the RAW data is damaged ({_reason(error)})") from None
    values = linear.astype(np.float32) / np.float32(65535)
    rgb = np.round(255 * srgb_from_linear(values)).astype(np.uint8)
    return Development(rgb, balance, float((linear == 65535).any(axis=-1).mean()))


def _daylight(multipliers: list[float]) -> tuple[float, float, float, float]:
    """Multipliers scaled so that the smallest is 1; sensors without a table keep their own balance."""
    r, g, b, g2 = (float(m) for m in (*multipliers, 0.0, 0.0, 0.0, 0.0)[:4])
    g2 = g2 or g
    if min(r, g, b) <= 0:
        return (1.0, 1.0, 1.0, 1.0)
    smallest = min(r, g, b, g2)
    return (r / smallest, g / smallest, b / smallest, g2 / smallest)


def _reason(error: Exception) -> str:
    text = error.args[0] if error.args else error
    return text.decode(errors="replace") if isinstance(text, bytes) else str(text)
