"""Which pictures of a sweep share a camera: one device, at one size and one zoom."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from devrf.calibration.intrinsics import Intrinsics, guess
from devrf.capture.exif import Exif

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
    sizes: Mapping[str, tuple[int, int]], exif: Mapping[str, Exif], known: Intrinsics | None
) -> list[DeviceGroup]:
    """Group pictures by size, device and zoom; each group has a camera of its own.

    Args:
        sizes: (width, height) of each picture.
        exif: What their tags say; pictures without tags may be left out.
        known: Board calibration of the device; used for the largest group of that size: held in a short
            sweep, a start in a longer one, which fixes the lens better than a board clip does.
    """
    zooms = _zooms(sizes, exif)
    split: dict[tuple[tuple[int, int], str, int], list[str]] = {}
    for name in sorted(sizes):
        key = (sizes[name], exif.get(name, Exif()).device, zooms.get(name, -1))
        split.setdefault(key, []).append(name)
    with_board = max(
        (key for key in split if known is not None and key[0] == (known.width, known.height)),
        key=lambda key: len(split[key]),
        default=None,
    )
    groups = []
    for key, names in sorted(split.items()):
        size, device, _ = key
        if known is not None and key == with_board:
            held = len(names) < PRINCIPAL_POINT_FROM
            groups.append(DeviceGroup(tuple(names), known, "board", held, _label(size, device, None)))
            continue
        focals = [f for name in names if name in exif and (f := exif[name].focal_px) is not None]
        focal = float(np.median(focals)) if focals else None
        source, label = "guess" if focal is None else "EXIF", _label(size, device, focal)
        groups.append(DeviceGroup(tuple(names), guess(*size, focal), source, False, label))
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
