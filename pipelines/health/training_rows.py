"""What both trainings measure: whether steps were too large, what was learned, and whether flow and clocks fit."""

from collections.abc import Iterator, Mapping
from statistics import fmean
from typing import Any

from devrf.capture.measure import Measure, highest, lowest
from devrf.reconstruct.evaluation.check_motion import MotionFit

MENDED = ("training-mended", "flow-contradicted", "clock-moved")
"""Codes which say that training mended something: the cause is real, the loss may not be."""


def restart_measures(metrics: Mapping[str, Any]) -> Iterator[Measure]:
    """Whether training ran away and was restarted; and what of the motion had to be left as it was."""
    if metrics["rate"] < 1:
        yield Measure("training-mended", metrics["restarts"], facts={"rate": metrics["rate"]})
    if metrics.get("keys_left"):
        text = f"it made the motion worse at {metrics['keys_left']} key times"
        yield Measure("training-mended", text, why="keys")


def contradicted_measures(contradicted: Mapping[str, float]) -> list[Measure]:
    """Whether pictures bear the flow out where anything moves; none where none was asked."""
    return [highest("flow-contradicted", contradicted)] if contradicted else []


def mover_measures(metrics: Mapping[str, Any]) -> Iterator[Measure]:
    """Whether tracked parts are found where they should be; none where motion is a field."""
    if "movers_gain_db" in metrics:
        lost = max(metrics["rigid_parts"], key=lambda part: part["longest_lost"])
        at = ", ".join(f"{x:.2f}" for x in lost["at"])
        yield Measure("motion-lost", lost["longest_lost"], facts={"at": at})


def moved_clock_measures(offsets_s: Mapping[str, float | None], why: str = "") -> list[Measure]:
    """The largest offset of a clock by what moves, if there is any.

    Args:
        offsets_s: Camera -> how much later it films than its clock says, seconds.
        why: `test` of test cameras, whose clocks are not moved.
    """
    known_ms = {name: 1e3 * offset_s for name, offset_s in offsets_s.items() if offset_s is not None}
    every = ", ".join(f"{name} {offset_ms:+.0f} ms" for name, offset_ms in known_ms.items())
    sizes = {name: abs(offset_ms) for name, offset_ms in known_ms.items()}
    return [highest("clock-moved", sizes, why=why, facts={"every": every})] if sizes else []


def in_motion_measures(cameras: Mapping[str, MotionFit]) -> Iterator[Measure]:
    """What was learned of motion, by the pictures of the training cameras alone: the worst camera each; none where no
    camera's pictures change.
    """
    if not cameras:
        return
    yield lowest("motion-gain", {name: fit.gain_db for name, fit in cameras.items()})
    yield highest("motion-empty", {name: fit.unreachable for name, fit in cameras.items()}, 100)
    yield highest("motion-still", {name: fit.unmoved for name, fit in cameras.items()}, 100)
    alone = [fit.alone for fit in cameras.values() if fit.alone is not None]
    if alone:
        yield Measure("motion-one-sided", 100 * fmean(alone))
    yield highest("motion-late", {name: abs(fit.better_at) for name, fit in cameras.items()})
