"""Whether the scene box fits what was filmed, as rows."""

from collections.abc import Sequence

import numpy as np

from devrf.calibration.bounds import Bounds, MotionMask
from devrf.calibration.box_checks import outside_box, seen_by_fewer
from devrf.capture.mattes.given import SWEEP
from devrf.capture.scene import PosedFrame
from devrf.pipelines.health.rows import HealthRow, row
from devrf.pipelines.scene_mattes import SceneMattes

LEAVES = 0.05  # of the subject's pixels outside the box: it leaves the box in this picture
MOST_LEAVING = 0.1  # of a camera's pictures
MOST_OUTSIDE = 0.5  # of the pixels that ever change; shadows and people who pass lie outside
MOST_FAR = 3.0  # far over the distance of 95 % of the points
MOST_SEEN_ONCE = 0.5  # of the box


def box_health(
    bounds: Bounds, masks: Sequence[MotionMask], mattes: SceneMattes | None, dynamic: Sequence[PosedFrame]
) -> list[HealthRow]:
    """Rows about subject and box, stray far points, and what the moving cameras see."""
    box = bounds.box_from_world, bounds.aabb
    rows = []
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
        rows.append(
            _at_most(
                f"pictures in which the subject leaves the box ({called})", float(counts[name]),
                f"of {len(leaving[name])}", most=float(int(MOST_LEAVING * len(leaving[name]))),
                remedy=f"What lies outside the box is not modelled in motion: look at scene/mattes/{name}: other "
                "things taken for the subject, or a part that only one camera sees; take them out, or move the cameras "
                "so that two see all of it.",
            )
        )  # fmt: skip
    elif masks and "hull" in bounds.basis:
        outside = max(float(outside_box(m.mask[None], m.camera, *box)[0]) for m in masks)
        rows.append(
            _at_most(
                "changing pixels outside the box (worst camera)", 100 * outside, "%", most=100 * MOST_OUTSIDE,
                remedy="Much of what changes in a camera lies outside the box and is not modelled in motion: keep "
                "people and shadows out of the picture, or see that two cameras see all that moves.",
            )
        )  # fmt: skip
    if bounds.far_over_most is not None:
        rows.append(
            _at_most(
                "far plane over where 95 % of the sweep's points are", bounds.far_over_most, "times", most=MOST_FAR,
                remedy="A few stray points are far away (reflections, sky, a window): mask them in the sweep "
                "(calibration.static_poses.masks).",
            )
        )  # fmt: skip
    cameras = {f.camera_name: f.camera for f in dynamic if f.split == "train"}
    if len(cameras) > 1:
        rows.append(
            _at_most(
                "share of the box that fewer than two moving cameras see",
                100 * seen_by_fewer(list(cameras.values()), *box, 2), "%", most=100 * MOST_SEEN_ONCE,
                remedy="Motion there is seen from one side only and cannot be told: turn the cameras towards the "
                "subject so that each part is in two pictures.",
            )
        )  # fmt: skip
    return rows


def _at_most(check: str, value: float, unit: str, *, most: float, remedy: str) -> HealthRow:
    return row(check, value, unit, warn_above=most, remedy=remedy)
