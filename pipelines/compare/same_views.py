"""Whether runs were measured on the same pictures: what is no comparison is refused, what limits one is said."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from devrf.capture.errors import InputError
from devrf.pipelines.compare.runs import ComparedRun, ViewKey
from devrf.pipelines.report.pictures import read_picture
from devrf.pipelines.report.run import evenly

LOOKED_AT = 3  # views whose true pictures are held against each other
OTHER_PICTURE = 12.0  # mean difference in grey levels from which two true pictures show something else
SAME_PICTURE = 0.5  # below: another decoder's rounding


def limits_of(base: ComparedRun, other: ComparedRun) -> tuple[str | None, list[str]]:
    """Why the measures of two runs cannot be held against each other (None: they can), and what limits it.

    Raises:
        InputError: They have no test view in common, or their test views show other scenes.
    """
    common = common_views(base.moving, other.moving) + common_views(base.still, other.still)
    both = f"{base.name} and {other.name}"
    if not common:
        raise InputError(
            f"{both} have no test view in common ({_cameras(base)}; {_cameras(other)}): another scene, or other test "
            "cameras; compare runs of one scene with the same capture.test_cameras"
        )
    notes = [
        f"{both}: {len(views)} of {len(a)} and {len(b)} {what} are the same; only those are compared"
        for what, a, b in (
            ("test views", base.moving, other.moving),
            ("held-out pictures", base.still, other.still),
        )
        if len(views := common_views(a, b)) < max(len(a), len(b))
    ]
    why = None
    for key in evenly(common, LOOKED_AT):
        apart, sizes = _apart(base, other, key)
        if apart is None or sizes is None:
            continue
        if apart > OTHER_PICTURE:
            raise InputError(
                f"{both} show something else in {key[0]}, frame {key[1]}: the true pictures differ by {apart:.0f} grey "
                f"levels (expected at most {OTHER_PICTURE:g}); compare runs of one scene"
            )
        if sizes[0] != sizes[1]:
            why = (
                f"{both} were measured on pictures of {sizes[0]} and {sizes[1]} pixels (reconstruct.image_scale): "
                "smaller pictures are easier, so their measures cannot be compared"
            )
        elif apart > SAME_PICTURE:
            notes.append(
                f"{both}: the true pictures differ by {apart:.1f} grey levels (other colours or mattes), which is part "
                "of every difference"
            )
            break
    return why, notes


def common_views(a: Iterable[ViewKey], b: Iterable[ViewKey]) -> list[ViewKey]:
    """Views that two runs share, in the order of the first."""
    there = set(b)
    return [key for key in a if key in there]


def picture_of(run: ComparedRun, key: ViewKey, kind: str) -> np.ndarray | None:
    """A picture of a view (`true`, `rendered`), uint8 RGB [H, W, 3]; None where it is not there."""
    file = (run.moving.get(key) or run.still.get(key) or {}).get(kind)
    return read_picture(run.folder.path / "evaluate" / file) if isinstance(file, str) else None


def _apart(
    base: ComparedRun, other: ComparedRun, key: ViewKey
) -> tuple[float | None, tuple[str, str] | None]:
    """Mean difference of the true pictures in grey levels, at the smaller size, and both sizes in words."""
    a, b = picture_of(base, key, "true"), picture_of(other, key, "true")
    if a is None or b is None:
        return None, None
    sizes = f"{a.shape[1]} × {a.shape[0]}", f"{b.shape[1]} × {b.shape[0]}"
    size = min(a.shape[1], b.shape[1]), min(a.shape[0], b.shape[0])
    small = [cv2.resize(p, size, interpolation=cv2.INTER_AREA).astype(np.float32) for p in (a, b)]
    return float(np.abs(small[0] - small[1]).mean()), sizes


def _cameras(run: ComparedRun) -> str:
    names: Sequence[str] = sorted({camera for camera, _ in (*run.moving, *run.still)})
    return f"{run.name}: {', '.join(names)}"
