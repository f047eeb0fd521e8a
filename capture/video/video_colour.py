"""One decoded picture of a video as 8-bit colours, and as a small grey picture to measure on.

Eight bits are converted by swscale with the matrix and range the file names; unlabelled HD is BT.709 and smaller is
BT.601, as players do it. More bits are converted in 16 and rounded to 8. HLG and PQ go through `tone_mapping.py`.
Primaries of P3 and BT.2020 are brought to those of sRGB; the small ones of standard definition are taken as these.
"""

import av
import cv2
import numpy as np
from av.video.plane import VideoPlane
from av.video.reformatter import Colorspace
from jaxtyping import Float32, UInt8

from devrf.capture.colour.primaries import BT2020, CHROMATICITIES, SRGB, srgb_from_primaries, srgb_of
from devrf.capture.colour.srgb import LINEAR_OF_LEVEL
from devrf.capture.colour.tone_mapping import Transfer, srgb_from_hdr
from devrf.capture.frames import shrunk

UNSPECIFIED_COLORSPACE = 2  # ITU-T H.273, matrix_coefficients
HDR_TRANSFERS: dict[int, Transfer] = {16: "PQ", 18: "HLG"}  # ITU-T H.273, transfer_characteristics
OTHER_CURVES = {8: "linear", 9: "logarithmic", 10: "logarithmic"}  # likewise; all else is near sRGB
FULL_RANGE = 2  # AVCOL_RANGE_JPEG
LIGHT = np.stack(3 * [LINEAR_OF_LEVEL], axis=1)
ROUND_TO_8 = 1 / 256  # swscale's 16-bit colours are its 8-bit ones, shifted
LUMA_FIRST = frozenset(  # formats whose first plane is luma in bytes
    f"{kind}{sub}" for kind in ("yuv", "yuvj") for sub in ("420p", "422p", "440p", "444p")
) | {"nv12", "nv21", "gray"}
LUMA_SHARES = {  # Kr, Kb of ITU-T H.273, matrix_coefficients
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
FULL_FROM_LIMITED = np.clip((np.arange(256) - 16) * (255 / 219), 0, 255).round().astype(np.uint8)


def bgr_of(picture: av.VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
    """B, G, R in sRGB as stored, before the file's turn. May share memory with nothing else; owned by the caller."""
    space = colour_matrix(picture)
    transfer = hdr_transfer(picture)
    wide = wide_primaries(picture)
    if transfer is None and wide is None and bits_of(picture) <= 8:
        return picture.to_ndarray(format="bgr24", src_colorspace=space, threads=1)
    deep = picture.to_ndarray(format="rgb48le", src_colorspace=space, threads=1)
    if transfer is not None:
        return np.ascontiguousarray(srgb_from_hdr(deep, transfer, wide or BT2020)[..., ::-1])
    rgb = cv2.convertScaleAbs(deep, alpha=ROUND_TO_8)
    if wide is not None:
        rgb = srgb_of(rgb, LIGHT, srgb_from_primaries(wide))
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)


def colour_matrix(picture: av.VideoFrame) -> int:
    """Number of its matrix in ITU-T H.273; a guess by size where the file names none."""
    if picture.colorspace != UNSPECIFIED_COLORSPACE:
        return picture.colorspace
    hd = picture.width >= 1280 or picture.height > 576
    return int(Colorspace.ITU709 if hd else Colorspace.ITU601)


def hdr_transfer(picture: av.VideoFrame) -> Transfer | None:
    """Which HDR curve codes this picture; None for all others."""
    return HDR_TRANSFERS.get(picture.color_trc)


def wide_primaries(picture: av.VideoFrame) -> int | None:
    """Which primaries wider than sRGB's this picture has; None for all others."""
    number = picture.color_primaries
    return number if number in CHROMATICITIES and number != SRGB else None


def small_luma(picture: av.VideoFrame, side_px: int) -> UInt8[np.ndarray, "small_height small_width"]:
    """Luma as grey levels, full range, area-averaged to a longer side of at most `side_px`; as stored.

    Where the file holds luma in bytes this costs a tenth of making colours.
    """
    luma = luma_plane(picture)
    if luma is None:
        return shrunk(cv2.cvtColor(bgr_of(picture), cv2.COLOR_BGR2GRAY), side_px)
    small = shrunk(luma, side_px)
    return small if is_full_range(picture) else cv2.LUT(small, FULL_FROM_LIMITED)


def small_rgb(picture: av.VideoFrame, side_px: int) -> UInt8[np.ndarray, "small_height small_width 3"]:
    """Colours, averaged to a longer side of at most `side_px`; as stored. Averages what is coded, not light."""
    luma = luma_plane(picture)
    if luma is None or len(picture.planes) != 3:
        return cv2.cvtColor(shrunk(bgr_of(picture), side_px), cv2.COLOR_BGR2RGB)
    small = shrunk(luma, side_px)
    size = (small.shape[1], small.shape[0])
    blue, red = (_chroma(plane_bytes(plane), size) for plane in picture.planes[1:])
    kr, kb = LUMA_SHARES.get(colour_matrix(picture), LUMA_SHARES[Colorspace.ITU709])
    if not is_full_range(picture):
        blue, red = blue * (255 / 224), red * (255 / 224)
        y = (small.astype(np.float32) - 16) * (255 / 219)
    else:
        y = small.astype(np.float32)
    r, b = y + 2 * (1 - kr) * red, y + 2 * (1 - kb) * blue
    g = (y - kr * r - kb * b) / (1 - kr - kb)
    return np.clip(np.stack([r, g, b], axis=-1).round(), 0, 255).astype(np.uint8)


def _chroma(
    plane: UInt8[np.ndarray, "height width"], size: tuple[int, int]
) -> Float32[np.ndarray, "small_height small_width"]:
    """A plane of colour differences at the size (width, height) of the small picture, around 0."""
    return cv2.resize(shrunk(plane, max(size)), size).astype(np.float32) - 128


def luma_plane(picture: av.VideoFrame) -> UInt8[np.ndarray, "height width"] | None:
    """The stored luma, not copied: read it while the picture is held. None where it is not in bytes of its own."""
    if picture.format.name not in LUMA_FIRST or hdr_transfer(picture) is not None:
        return None
    return plane_bytes(picture.planes[0])


def plane_bytes(plane: VideoPlane) -> UInt8[np.ndarray, "height width"]:
    """A plane of bytes, not copied: read it while its picture is held."""
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def is_full_range(picture: av.VideoFrame) -> bool:
    """Whether the file says that luma uses all of 0 to 255."""
    return picture.color_range == FULL_RANGE or picture.format.name.startswith(("yuvj", "gray"))


def bits_of(picture: av.VideoFrame) -> int:
    """Of a colour of a stored picture: 8, or more."""
    return max(component.bits for component in picture.format.components)
