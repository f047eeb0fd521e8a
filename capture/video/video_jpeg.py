"""A decoded picture as JPEG, straight from its planes: no way round by RGB and back.

JPEG (JFIF) holds full-range luma and colour by BT.601's matrix; HD video holds limited range and BT.709's. Both are
luma and two colour differences, so one 3x3 matrix leads from one to the other, and grey stays grey in it: colour
differences stay at half the size in which the video has them, and luma gets a small part of them added.
"""

from functools import cache

import av
import cv2
import numpy as np
import simplejpeg
from jaxtyping import Float, UInt8

from devrf.capture.orientation import Upright
from devrf.capture.video.video_colour import (
    LUMA_SHARES,
    colour_matrix,
    hdr_transfer,
    is_full_range,
    plane_bytes,
    wide_primaries,
)

PLANES_420 = frozenset(("yuv420p", "yuvj420p"))
JFIF = 5
AS_STORED = Upright()
MIDDLE = 128


def jpeg_of(picture: av.VideoFrame, quality: int, upright: Upright = AS_STORED) -> bytes | None:
    """The picture as JPEG with halved colour; None as of `jfif_planes`.

    Args:
        picture: As decoded.
        quality: 1 to 100.
        upright: What makes it upright.
    """
    planes = jfif_planes(picture)
    if planes is None:
        return None
    turned = [np.ascontiguousarray(upright.apply(p)) for p in planes]
    return simplejpeg.encode_jpeg_yuv_planes(*turned, quality=quality)


def jfif_planes(picture: av.VideoFrame) -> list[UInt8[np.ndarray, "_ _"]] | None:
    """Full-range luma [h, w] and BT.601 colour differences [h/2, w/2] (rounded up).

    None where it is not 4:2:0, or its primaries or curve are not sRGB's.
    """
    matrix = LUMA_SHARES.get(colour_matrix(picture))
    wide = hdr_transfer(picture) is not None or wide_primaries(picture) is not None
    if picture.format.name not in PLANES_420 or wide or matrix is None:
        return None
    luma, blue, red = (plane_bytes(plane) for plane in picture.planes)
    full = is_full_range(picture)
    black, luma_gain, gain = (0, 1.0, 1.0) if full else (16, 255 / 219, 255 / 224)
    to_jfif = gain * _to_jfif(*matrix)
    if full and np.allclose(to_jfif, [[0, 0], [1, 0], [0, 1]]):
        return [luma, blue, red]

    def mixed(row: int) -> UInt8[np.ndarray, "_ _"]:
        a, b = to_jfif[row]
        return cv2.addWeighted(blue, a, red, b, MIDDLE * (1 - a - b))

    height, width = luma.shape
    part = cv2.resize(mixed(0), None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)[:height, :width]
    return [cv2.addWeighted(luma, luma_gain, part, 1.0, -black * luma_gain - MIDDLE), mixed(1), mixed(2)]


@cache
def _to_jfif(kr: float, kb: float) -> Float[np.ndarray, "3 2"]:
    """What colour differences of a matrix add to JFIF's luma and colour differences."""
    return (_from_rgb(*LUMA_SHARES[JFIF]) @ np.linalg.inv(_from_rgb(kr, kb)))[:, 1:]


def _from_rgb(kr: float, kb: float) -> Float[np.ndarray, "3 3"]:
    luma = np.array([kr, 1 - kr - kb, kb])
    return np.stack(
        [luma, (np.array([0, 0, 1]) - luma) / (2 - 2 * kb), (np.array([1, 0, 0]) - luma) / (2 - 2 * kr)]
    )
