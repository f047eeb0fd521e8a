"""Pictures that no lens makes: all around (equirectangular), or of two lenses at once (two circles, two halves).

Files say so by a tag (Google's spherical video boxes, which FFmpeg hands on; GPano of photos), or it is seen. A picture
of all around is twice as wide as high, goes on from its right edge at its left one, and its first and last row are one
point each, drawn out. Two circles leave the corners of both halves black; two eyes show nearly the same in both halves.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.measure import Measure

Projection = Literal["equirectangular", "fisheyes", "eyes", "panorama"]
Picture = UInt8[np.ndarray, "_ _ 3"]
Grey = Float[np.ndarray, "_ _"]

WORDS: dict[Projection, str] = {
    "equirectangular": "an equirectangular (spherical, 360°) picture: all around the camera, drawn out to a rectangle",
    "fisheyes": "two circles: what both lenses of a 360° camera see, not stitched",
    "eyes": "two halves that show the same: a stereo (3-D, 180°) film",
    "panorama": "a panorama that was stitched of several pictures",
}
BY_SPHERE: dict[int, Projection] = {  # AVSphericalProjection; cubes are cut from all around, too
    0: "equirectangular",
    1: "equirectangular",
    2: "equirectangular",
    3: "eyes",
    5: "fisheyes",
}
SIDE_PX, LEAST_PX = 320, 32  # of the picture in which is looked, and of its height
# Both edges of 60 clips of 13 scenes agree as if by chance, below 0.35 in the median; of a film of all around by 0.84.
SEAM = 0.6  # correlation along the edge, of what is finer than a fifth of the height
ENOUGH = 12  # pictures of a camera
POLE = 0.5  # contrast along the first or the last row, of that of the rows between; of the clips 0.3 and more
FINEST = 1.5  # levels; an edge with less contrast says nothing
BLACK, SEEN = 12.0, 30.0  # mean levels of a circle's corners and of itself
HALVES = 0.75  # correlation of the halves, where they differ by a shift of at most this share of their width
MOST_SHIFT = 0.08


def of_sphere(tag: bytes | None, stereo: bytes | None) -> Projection | None:
    """What FFmpeg's AVSphericalMapping and AVStereo3D of a frame say; None: nothing, or a flat picture."""
    if stereo is not None and len(stereo) >= 4 and struct.unpack_from("=i", stereo)[0] in (1, 2):
        return "eyes"
    return None if tag is None or len(tag) < 4 else BY_SPHERE.get(struct.unpack_from("=i", tag)[0])


def of_xmp(xmp: bytes | str | None) -> Projection | None:
    """What a photo's XMP says (Google's GPano)."""
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else xmp or ""
    if "GPano:ProjectionType" not in text:
        return None
    kind = text.split("GPano:ProjectionType", 1)[1][:40].lower()
    return "equirectangular" if "equirect" in kind else "panorama"


def projection_of(said: Iterable[Projection | None], pictures: Sequence[Picture]) -> Projection | None:
    """What the pictures of one camera are, by their tags, else by what they show; None where each might be a lens's."""
    for told in said:
        if told is not None:
            return told
    shown = [grey for grey in map(_small, pictures) if grey.std() > FINEST]
    tests: tuple[tuple[Projection, Callable[[Grey], bool]], ...] = (
        ("equirectangular", _is_all_around),
        ("fisheyes", _has_circles),
        ("eyes", _has_eyes),
    )
    for kind, test in tests:
        if sum(map(test, shown)) > len(shown) / 2:
            return kind
    return None


def odd_ones(said: Sequence[Projection | None]) -> set[int]:
    """Which of a folder's photos no lens made, by their tags, among more that one did: they are no camera's."""
    tagged = {n for n, told in enumerate(said) if told is not None}
    return tagged if 2 * len(tagged) < len(said) else set()


def projection_faults(kind: Projection | None, source: str = "") -> list[Measure]:
    """What to say of a camera with such pictures, of the file or folder `source`."""
    facts = {"source": source}
    return [] if kind is None else [Measure("coding", WORDS[kind], why=kind, facts=facts, found="fail")]


def _small(picture: Picture) -> Grey:
    grey = cv2.cvtColor(picture[:, :, :3], cv2.COLOR_RGB2GRAY)
    scale = SIDE_PX / max(grey.shape)
    if scale < 1:
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return grey.astype(np.float64)


def _is_all_around(grey: Grey) -> bool:
    height, width = grey.shape
    if abs(width - 2 * height) > 1 or height < LEAST_PX:
        return False
    first, last = (_fine(cv2.blur(edge, (1, 3))) for edge in (grey[:, :1], grey[:, -1:]))
    if min(first.std(), last.std()) < FINEST:
        return False
    contrast = float(np.median(grey[height // 4 : -height // 4].std(axis=1)))
    poles = [float(row.std()) < POLE * contrast for row in (grey[0], grey[-1])]
    return any(poles) and _alike(first, last) > SEAM


def _has_circles(grey: Grey) -> bool:
    return any(all(map(_is_circle, halves)) for halves in _halves(grey))


def _is_circle(half: Grey) -> bool:
    height, width = half.shape
    if abs(width - height) > 0.02 * height or height < LEAST_PX:
        return False
    y, x = (np.mgrid[:height, :width] + 0.5) / height - 0.5
    r = np.hypot(x, y)
    return float(half[r > 0.56].mean()) < BLACK and float(half[r < 0.4].mean()) > SEEN


def _has_eyes(grey: Grey) -> bool:
    height, width = grey.shape
    if (
        width < 2 * height - 1 or height < LEAST_PX
    ):  # of others only tags tell; repeated things fill both halves, too
        return False
    one, other = (_fine(half) for half in _halves(grey)[0])
    shift = max(1, round(MOST_SHIFT * one.shape[1]))
    inner = one[shift:-shift, shift:-shift]
    if min(inner.std(), other.std()) < FINEST:
        return False
    match = cv2.matchTemplate(other.astype(np.float32), inner.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    return float(match.max()) > HALVES


def _halves(grey: Grey) -> list[tuple[Grey, Grey]]:
    """Left and right, above and below."""
    height, width = grey.shape[0] // 2, grey.shape[1] // 2
    return [(grey[:, :width], grey[:, -width:]), (grey[:height], grey[-height:])]


def _fine(grey: Grey) -> Grey:
    """What is finer than a fifth of the height."""
    return grey - cv2.blur(grey, (1, max(5, grey.shape[0] // 5)))


def _alike(a: Grey, b: Grey) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-9))
