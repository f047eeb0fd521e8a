"""Whether the scene box fits what was filmed, as rows."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from devrf.calibration.bounds import Bounds
from devrf.calibration.box_checks import CutOff, cut_off, not_explained, not_swept, outside_box, seen_by_fewer
from devrf.calibration.motion_masks import MotionMask
from devrf.capture.mattes.given import SWEEP
from devrf.capture.scene import PosedFrame
from devrf.pipelines.health.rows import HealthRow, listed, row
from devrf.pipelines.scene_mattes import SceneMattes

LEAVES = 0.05  # of the subject's pixels outside the box: it leaves the box in this picture
MOST_LEAVING = 0.1  # of a camera's pictures
MOST_UNEXPLAINED = 0.15  # of the pixels that ever change; in four captures at most 0.11
MOST_CUT = 0.02  # of what moves in a camera, in one piece beyond the box; in six captures at most 0.00
MOST_FAR = 3.0  # far over the distance of 95 % of the points
MOST_SEEN_ONCE = 0.5  # of the box
MOST_NOT_SWEPT = 0.2  # of the box; in six captures at most 0.003


@listed
def box_health(
    bounds: Bounds,
    moves: Mapping[str, MotionMask],
    mattes: SceneMattes | None,
    dynamic: Sequence[PosedFrame],
    static: Sequence[PosedFrame] = (),
) -> Iterator[HealthRow]:
    """Rows about subject and box, stray far points, and what the moving cameras see.

    Args:
        moves: What moves in each fixed camera; not asked where there are mattes.
    """
    box = bounds.box_from_world, bounds.aabb
    if mattes is not None:
        leaving = {
            name: np.concatenate(
                [
                    outside_box(fact.small[None], camera, *box)
                    for fact, camera in zip(made.facts, mattes.small[name], strict=True)
                ]
            )
            for name, made in mattes.cameras.items()
        }
        counts = {name: int((shares > LEAVES).sum()) for name, shares in leaving.items()}
        name = max(counts, key=lambda n: counts[n] / len(leaving[n]))
        called = "the sweep" if name == SWEEP else name
        yield row(
            f"pictures in which the subject leaves the box ({called})", float(counts[name]),
            f"of {len(leaving[name])}", warn_above=float(int(MOST_LEAVING * len(leaving[name]))),
            remedy=f"What lies outside the box is not modelled in motion: look at scene/mattes/{name}: other "
            "things taken for the subject, or a part that only one camera sees; take them out, or move the cameras "
            "so that two see all of it.",
        )  # fmt: skip
    elif moves:
        if "hull" in bounds.basis:
            found = not_explained(list(moves.values()), *box)
            left = {name: one for name, one in zip(moves, found, strict=True) if one is not None}
            name = max(left, key=lambda n: left[n].share, default="none")
            where = "; ".join(
                f"{n}, {_place(one)}" for n, one in left.items() if one.share > MOST_UNEXPLAINED
            )
            yield row(
                f"changing pixels that nothing in the box explains, worst camera ({name})",
                100 * left[name].share if left else 0.0, "%", warn_above=100 * MOST_UNEXPLAINED,
                remedy="What changes there no other camera shows in the box, and it is not modelled in motion: "
                f"most of it is in {where}. Keep people and shadows out of the picture, or see that two cameras see "
                "all that moves.",
            )  # fmt: skip
        cut = {name: found for name, m in moves.items() if (found := cut_off(m, *box)) is not None}
        name = max(cut, key=lambda n: cut[n].share, default="none")
        where = "; ".join(f"{n} sees it {_place(one)}" for n, one in cut.items() if one.share > MOST_CUT)
        yield row(
            f"something that moves and is cut off by the box, worst camera ({name})",
            100 * cut[name].share if cut else 0.0, "% of what moves", warn_above=100 * MOST_CUT,
            remedy=f"Something moves beyond the box and is not modelled in motion: {where}. Keep it still or out of "
            "the pictures; if it belongs to the scene, turn the cameras so that most of them see all of it.",
        )  # fmt: skip
    if bounds.far_over_most is not None:
        yield row(
            "far plane over where 95 % of the sweep's points are", bounds.far_over_most, "times", warn_above=MOST_FAR,
            remedy="A few stray points are far away (reflections, sky, a window): mask them in the sweep "
            "(calibration.static_poses.masks).",
        )  # fmt: skip
    cameras = {f.camera_name: f.camera for f in dynamic if f.split == "train"}
    if len(cameras) > 1:
        yield row(
            "share of the box that fewer than two moving cameras see",
            100 * seen_by_fewer(list(cameras.values()), *box, 2), "%", warn_above=100 * MOST_SEEN_ONCE,
            remedy="Motion there is seen from one side only and cannot be told: turn the cameras towards the "
            "subject so that each part is in two pictures.",
        )  # fmt: skip
    if cameras and static:
        yield row(
            "share of the box that the sweep did not come near",
            100 * not_swept([f.camera for f in static], list(cameras.values()), *box),
            "%", warn_above=100 * MOST_NOT_SWEPT,
            remedy="What moves there is unknown at rest, or too coarse: let the sweep go all around the subject, as "
            "near as the fixed cameras stand, with the subject in the picture.",
        )  # fmt: skip


def _place(found: CutOff) -> str:
    """Where in a picture something is, in words."""
    x, y = found.place
    return f"{100 * x:.0f} % from the left and {100 * y:.0f} % from the top of its picture"
