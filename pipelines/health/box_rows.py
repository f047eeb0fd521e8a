"""Whether the scene box fits what was filmed."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from devrf.calibration.extent.bounds import Bounds
from devrf.calibration.extent.box_checks import (
    CutOff,
    cut_off,
    not_explained,
    not_swept,
    outside_box,
    seen_by_fewer,
)
from devrf.calibration.extent.matted import SceneMattes
from devrf.calibration.extent.motion_masks import MotionMask
from devrf.capture.mattes.given import SWEEP
from devrf.capture.measure import Measure
from devrf.capture.scene import PosedFrame
from devrf.pipelines.health.judge import warns_at

LEAVES = 0.05  # of the subject's pixels outside the box: it leaves the box in this picture
MOST_LEAVING = 0.1  # of a camera's pictures


def box_measures(
    bounds: Bounds,
    moves: Mapping[str, MotionMask],
    mattes: SceneMattes | None,
    dynamic: Sequence[PosedFrame],
    static: Sequence[PosedFrame] = (),
) -> Iterator[Measure]:
    """Subject and box, and what the moving cameras see.

    Args:
        moves: What moves in each fixed camera; not asked where there are mattes.
    """
    box = bounds.box_from_world, bounds.aabb
    if mattes is not None:
        yield from _leaving(mattes, box)
    elif moves:
        if "hull" in bounds.basis:
            left = not_explained(list(moves.values()), *box, bounds.before)
            found = dict(zip(moves, left, strict=True))
            yield _worst("box-unexplained", found, ", ")
        yield _worst("box-cuts", {name: cut_off(m, *box) for name, m in moves.items()}, " sees it ")
    cameras = {f.camera_name: f.camera for f in dynamic if f.split == "train"}
    if len(cameras) > 1:
        yield Measure("box-one-sided", 100 * seen_by_fewer(list(cameras.values()), *box, 2))
    if cameras and static:
        far = not_swept([f.camera for f in static], list(cameras.values()), *box)
        yield Measure("box-not-swept", 100 * far)


def _leaving(mattes: SceneMattes, box: tuple[np.ndarray, np.ndarray]) -> Iterator[Measure]:
    """The camera in most of whose pictures the subject leaves the box, where that are too many."""
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
    if counts[name] > int(MOST_LEAVING * len(leaving[name])):
        text = f"the subject leaves it in {counts[name]} of {len(leaving[name])} pictures"
        yield Measure("box-cuts", text, "the sweep" if name == SWEEP else name, "mattes", {"folder": name})


def _worst(code: str, found: Mapping[str, CutOff | None], sees: str) -> Measure:
    """The camera with the largest share; its remedy names the place in every camera that has too much."""
    most = warns_at(code) / 100
    shares = {name: one.share for name, one in found.items() if one is not None}
    name = max(shares, key=lambda n: shares[n], default="none")
    where = "; ".join(
        f"{n}{sees}{_place(one)}" for n, one in found.items() if one is not None and one.share > most
    )
    return Measure(code, 100 * shares.get(name, 0.0), name, facts={"where": where})


def _place(found: CutOff) -> str:
    """Where in a picture something is, in words."""
    x, y = found.place
    return f"{100 * x:.0f} % from the left and {100 * y:.0f} % from the top of its picture"
