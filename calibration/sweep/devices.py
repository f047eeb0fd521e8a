"""Which pictures of a sweep share a camera: one device, at one size and one zoom."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from devrf.calibration.intrinsics import Intrinsics, guess
from devrf.capture.exif import Exif
from devrf.capture.orientation import Upright, by_exif

PRINCIPAL_POINT_FROM = 20  # pictures of a camera; fewer do not fix its principal point
SAME_ZOOM = 0.03  # relative; steps of EXIF focal lengths that are rounding, not a turn of the zoom ring


@dataclass(frozen=True)
class DeviceGroup:
    """Pictures of one device at one size and zoom: they share a camera.

    Attributes:
        names: Picture files, relative to the picture folder.
        intrinsics: Start values, or what to hold fixed.
        source: Where the focal length is from; a guess is no prior.
        fixed: Hold the intrinsics (they come from a board).
        label: What tells it from the others, in words.
    """

    names: tuple[str, ...]
    intrinsics: Intrinsics
    source: Literal["guess", "EXIF", "board"] = "guess"
    fixed: bool = False
    label: str = ""


def device_groups(
    sizes: Mapping[str, tuple[int, int]],
    exif: Mapping[str, Exif],
    known: Intrinsics | None,
    pixel_aspect: float = 1.0,
    turns: Mapping[str, Upright] | None = None,
) -> list[DeviceGroup]:
    """Group pictures by size, device and zoom; each group has a camera of its own.

    Args:
        sizes: (width, height) of each picture.
        exif: What their tags say; pictures without tags may be left out.
        known: Board calibration of the device, of its stored pictures; used for the largest group of that size: held
            in a short sweep, a start in a longer one, which fixes the lens better than a board clip does.
        pixel_aspect: Width of a pixel over its height.
        turns: How each picture was made upright; None: all are as they are stored.
    """
    zooms, turns = _zooms(sizes, exif), turns or {}
    split: dict[tuple[tuple[int, int], str, int, int], list[str]] = {}
    for name in sorted(sizes):
        orientation = turns.get(name, Upright()).orientation
        key = (sizes[name], exif.get(name, Exif()).device, zooms.get(name, -1), orientation)
        split.setdefault(key, []).append(name)
    with_board = max(
        (
            key
            for key in split
            if known is not None and by_exif(key[3]).size(*key[0]) == (known.width, known.height)
        ),
        key=lambda key: len(split[key]),
        default=None,
    )
    groups = []
    for key, names in sorted(split.items()):
        size, device, _, orientation = key
        if known is not None and key == with_board:
            held = len(names) < PRINCIPAL_POINT_FROM
            lens = known.turned(by_exif(orientation))
            groups.append(DeviceGroup(tuple(names), lens, "board", held, _label(size, device, None)))
            continue
        focals = [f for name in names if name in exif and (f := exif[name].focal_px) is not None]
        focal = float(np.median(focals)) if focals else None
        source, label = "guess" if focal is None else "EXIF", _label(size, device, focal)
        groups.append(DeviceGroup(tuple(names), guess(*size, focal, pixel_aspect), source, False, label))
    return groups


def _zooms(sizes: Mapping[str, tuple[int, int]], exif: Mapping[str, Exif]) -> dict[str, int]:
    """Cluster of EXIF focal lengths (relative to the longer side) that each picture with one is in."""
    ratios = {n: t.focal_px / max(sizes[n]) for n, t in exif.items() if t.focal_px and n in sizes}
    ordered = sorted(ratios, key=lambda name: ratios[name])
    out, cluster = {}, 0
    for before, name in zip([*ordered[:1], *ordered], ordered, strict=False):
        cluster += ratios[name] > (1 + SAME_ZOOM) * ratios[before]
        out[name] = cluster
    return out


def _label(size: tuple[int, int], device: str, focal_px: float | None) -> str:
    zoom = "" if focal_px is None else f" at {focal_px:.0f} px"
    return f"{device or 'camera'} {size[0]}x{size[1]}{zoom}"
