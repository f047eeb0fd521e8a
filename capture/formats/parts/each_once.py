"""Each picture of a data set once: entries that show one file's content from one place are one picture.

Contents are compared, not names: a list that overlaps another, or a copy under another name, would be tested on
and trained on.
"""

from dataclasses import replace

import numpy as np

from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.scene import PosedFrame, SparsePoints
from devrf.capture.system.amounts import some
from devrf.capture.system.doubles import doubles

# Of a matrix; of the cameras' extent: poses of copies may be found one by one.
SAME_ROTATION, SAME_PLACE = 1e-2, 1e-2


def each_once(found: Pictures, notes: list[str]) -> Pictures:
    """The pictures without those that are there already; where one is tested on and trained on, it is trained on.

    Args:
        found: What a reader found.
        notes: What is left out is added here, in words.
    """
    static, dynamic = _kept(found.static, notes), _kept(found.dynamic, notes)
    was_test, is_test = (
        any(found.static[n].split == "test" for n in numbers)
        for numbers in (range(len(found.static)), static)
    )
    first_kept = len(found.static) - found.keep
    return replace(
        found,
        static=tuple(found.static[n] for n in static),
        dynamic=tuple(found.dynamic[n] for n in dynamic),
        has_split=found.has_split and (is_test or not was_test),
        keep=sum(n >= first_kept for n in static),
        bounds=None if found.bounds is None else found.bounds[static],
        points=None if found.points is None else _points_of(found.points, static, len(found.static)),
    )


def _kept(frames: tuple[PosedFrame, ...], notes: list[str]) -> list[int]:
    """Which frames stay, in order."""
    by_worth = sorted(range(len(frames)), key=lambda n: frames[n].split != "train")
    again = {by_worth[n]: by_worth[first] for n, first in doubles([frames[n].path for n in by_worth]).items()}
    centres = np.array([f.camera.centre for f in frames]).reshape(-1, 3)
    reach = SAME_PLACE * float(np.linalg.norm(np.ptp(centres, axis=0))) if again else 0.0

    def same_view(n: int, other: int) -> bool:
        a, b = (frames[k].camera.cam_from_world[:, :3] for k in (n, other))
        near = float(np.linalg.norm(centres[n] - centres[other])) <= reach
        return near and float(np.abs(a - b).max()) <= SAME_ROTATION and frames[n].time == frames[other].time

    twice = {n: first for n, first in sorted(again.items()) if same_view(n, first)}
    for tested, words in (
        (True, "test pictures are trained on too, and are not tested on"),
        (False, "pictures are there twice, and are used once"),
    ):
        which = [n for n, first in twice.items() if (frames[n].split != frames[first].split) is tested]
        if which:
            names = some([frames[n].path.name for n in which])
            notes.append(f"{len(which)} {words}: {names}")
    return [n for n in range(len(frames)) if n not in twice]


def _points_of(points: SparsePoints, kept: list[int], count: int) -> SparsePoints:
    """Observations in the pictures that are kept."""
    place = np.full(count, -1)
    place[kept] = np.arange(len(kept))
    stays = place[points.obs_frame] >= 0
    return SparsePoints(points.xyz, points.obs_point[stays], place[points.obs_frame[stays]])
