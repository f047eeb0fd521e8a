"""Which colours a photo says that its levels mean, and the way from there to sRGB.

Said by an ICC profile (ICC.1:2022: matrix and tone reproduction curves), by PNG's cICP, gAMA and cHRM (PNG 3), or by
EXIF's name of the option file for Adobe RGB (DCF 2.0), which cameras write without a profile.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import ExifTags, Image

from devrf.capture.colour.primaries import (
    ADOBE_RGB,
    CHROMATICITIES,
    NAMES,
    SRGB,
    srgb_from_chromaticities,
    srgb_from_primaries,
    srgb_of,
    white_to_white,
)
from devrf.capture.colour.srgb import LINEAR_OF_LEVEL
from devrf.capture.exif import png_chunk

ICC_TAGS_AT = 128  # number of tags, after the header; then signature, offset and size of each
FIXED = 65536.0  # s15Fixed16Number
# Columns: red, green and blue of sRGB as profiles have them, adapted to D50 by Bradford.
SRGB_IN_D50 = np.array(
    [
        [0.4360747, 0.3850649, 0.1430804],
        [0.2225045, 0.7168786, 0.0606169],
        [0.0139322, 0.0971045, 0.7141733],
    ]
)
SAME_LEVELS = 2  # of 255: what makers' own profiles of sRGB differ by
GRID = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 51)]), axis=-1).reshape(1, -1, 3).astype(np.uint8)
LEVELS = np.arange(256) / 255
# Of light: what curves fall by, and what they make of black and white.
ROUNDING, DARK, BRIGHT = 1e-3, 0.2, 0.8
LEAST_GAMMA = 1.6  # the curves of displays and cameras are 1.8 to 2.4; less is linear light or a logarithm
GAMMA_OF_SRGB = (2.1, 2.3)  # PNG: what writers of sRGB put into gAMA is 2.2, and means sRGB's own curve
ADOBE_GAMMA = 563 / 256
# ITU-T H.273, transfer characteristics taken as sRGB's, as of clips.
SAME_CURVE = frozenset((1, 2, 6, 13, 14, 15))
CURVES = {4: 2.2, 5: 2.8, 8: 1.0}  # likewise: exponent from levels to light


@dataclass(frozen=True)
class PhotoSpace:
    """What the levels of a photo mean, where that is not sRGB.

    Attributes:
        name: As its profile says.
        light: Linear light in [0, 1] of each level of red, green and blue; None: it cannot be told, the levels are
            taken as sRGB.
        srgb_from_own: Takes it to sRGB's primaries.
    """

    name: str
    light: Float32[np.ndarray, "256 3"] | None
    srgb_from_own: Float32[np.ndarray, "3 3"]

    @property
    def linear(self) -> bool:
        """Whether levels are something like linear light, of which 8 bits hold few dark ones."""
        return self.light is not None and bool(self.light[128, 1] > LEVELS[128] ** LEAST_GAMMA)

    def srgb(
        self, levels: UInt8[np.ndarray, "height width channels"]
    ) -> UInt8[np.ndarray, "height width channels"]:
        """The picture in sRGB."""
        return levels if self.light is None else srgb_of(levels, self.light, self.srgb_from_own)


def photo_space(image: Image.Image) -> PhotoSpace | None:
    """What an open photo says of its levels; None where they are sRGB, or nothing is said."""
    coded = png_chunk(image, b"cICP", behind=False)
    if coded is not None and len(coded) == 4:
        return _of_numbers(coded[0], coded[1])
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes) and profile:
        return _of_profile(profile)
    if image.format == "PNG":
        return _of_png(image)
    interoperability = image.getexif().get_ifd(ExifTags.IFD.Interop).get(1)
    if interoperability == "R03":
        return _space(NAMES[ADOBE_RGB], LEVELS**ADOBE_GAMMA, srgb_from_primaries(ADOBE_RGB))
    return None


def as_srgb(
    levels: UInt8[np.ndarray, "height width channels"], space: PhotoSpace | None
) -> UInt8[np.ndarray, "height width channels"]:
    """A photo's levels as sRGB."""
    return levels if space is None else space.srgb(levels)


def _space(
    name: str, light: Float[np.ndarray, "*levels"], srgb_from_own: Float32[np.ndarray, "3 3"]
) -> PhotoSpace | None:
    """None where all colours come out as they are; not read where the curve is none from black to white."""
    columns = light if light.ndim == 2 else np.stack(3 * [light], axis=1)
    rises = np.isfinite(columns).all() and np.diff(columns, axis=0).min() > -ROUNDING
    if not (
        rises and columns[0].max() < DARK and columns[-1].min() > BRIGHT and columns[128].max() > ROUNDING
    ):
        return _unread(name)
    table = np.clip(columns, 0, 1).astype(np.float32)
    off = srgb_of(GRID, table, srgb_from_own).astype(int) - GRID
    return None if np.abs(off).max() <= SAME_LEVELS else PhotoSpace(name, table, srgb_from_own)


def _unread(name: str) -> PhotoSpace:
    return PhotoSpace(name, None, np.eye(3, dtype=np.float32))


def _of_numbers(primaries: int, transfer: int) -> PhotoSpace | None:
    """By H.273's numbers of primaries and transfer characteristics."""
    name = f"{NAMES.get(primaries, f'primaries {primaries}')} (curve {transfer} of H.273)"
    if transfer not in SAME_CURVE and transfer not in CURVES:
        return _unread(name)
    light = LINEAR_OF_LEVEL if transfer in SAME_CURVE else LEVELS ** CURVES[transfer]
    return _space(name, light, srgb_from_primaries(primaries if primaries in CHROMATICITIES else SRGB))


def _of_png(image: Image.Image) -> PhotoSpace | None:
    """By gAMA and cHRM, which stand in for sRGB where that is written too."""
    gamma, places = image.info.get("gamma"), image.info.get("chromaticity")
    if "srgb" in image.info or (gamma is None and places is None):
        return None
    exponent = 1 / gamma if gamma else 2.2
    like_srgb = GAMMA_OF_SRGB[0] <= exponent <= GAMMA_OF_SRGB[1]
    matrix, name = srgb_from_primaries(SRGB), f"a gamma of {exponent:.2g}"
    if places is not None:
        name += " and primaries of its own"
        try:  # white comes first
            matrix = srgb_from_chromaticities(np.roll(np.array(places).reshape(4, 2), -1, axis=0))
        except (ValueError, np.linalg.LinAlgError):
            return _unread(name)
    return _space(name, LINEAR_OF_LEVEL if like_srgb else LEVELS**exponent, matrix)


@lru_cache(maxsize=32)
def _of_profile(profile: bytes) -> PhotoSpace | None:
    """By an ICC profile; those of more than a matrix and curves are not read."""
    name = "a profile that is damaged"
    try:
        (count,) = struct.unpack_from(">I", profile, ICC_TAGS_AT)
        entries = (
            struct.unpack_from(">4sII", profile, ICC_TAGS_AT + 4 + 12 * n) for n in range(min(count, 100))
        )
        tags = {key: profile[at : at + size] for key, at, size in entries}
        name = _text(tags.get(b"desc", b"")) or "a profile without a name"
        if b"kTRC" in tags:
            return _space(name, _curve(tags[b"kTRC"]), srgb_from_primaries(SRGB))
        curves = np.stack([_curve(tags[key]) for key in (b"rTRC", b"gTRC", b"bTRC")], axis=1)
        columns = [struct.unpack_from(">3i", tags[key], 8) for key in (b"rXYZ", b"gXYZ", b"bXYZ")]
        own = np.array(columns).T / FIXED
        return _space(name, curves, white_to_white(np.linalg.solve(SRGB_IN_D50, own)))
    except (struct.error, KeyError, ValueError, np.linalg.LinAlgError):
        return _unread(name)


def _curve(tag: bytes) -> Float[np.ndarray, " 256"]:
    """Light of each level by a curve of a profile.

    Raises:
        ValueError, struct.error: It is none.
    """
    kind, x = tag[:4], LEVELS
    if kind == b"para":
        (formula,) = struct.unpack_from(">H", tag, 8)
        if formula > 4:
            raise ValueError(f"formula {formula}")
        count = (1, 3, 4, 5, 7)[formula]
        g, *rest = (value / FIXED for value in struct.unpack_from(f">{count}i", tag, 12))
        a, b, c, d, e, f = (*rest, *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)[len(rest) :])
        if formula in (1, 2):  # one constant, below and above
            c, d, e, f = 0.0, -b / a if a else 0.0, c, c
        with np.errstate(all="ignore"):  # what is no number is no curve
            return np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
    if kind != b"curv":
        raise ValueError(f"curve {kind!r}")
    (points,) = struct.unpack_from(">I", tag, 8)
    values = np.array(struct.unpack_from(f">{min(points, 65536)}H", tag, 12))
    if points < 2:
        return x ** (values[0] / 256 if points else 1.0)
    return np.interp(x, np.linspace(0, 1, len(values)), values / 65535)


def _text(tag: bytes) -> str:
    """The first words of a description."""
    if tag[:4] == b"mluc":
        length, at = struct.unpack_from(">II", tag, 20)
        return tag[at : at + length].decode("utf-16-be", "replace").strip(" \0")
    return tag[12:].split(b"\0")[0].decode("ascii", "replace").strip()
