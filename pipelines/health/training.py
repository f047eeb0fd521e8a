"""Health rows of both trainings: whether steps were too large, and whether the flow fits the pictures."""

from collections.abc import Iterator, Mapping
from typing import Any

from devrf.flow.agreement import MOSTLY_CONTRADICTED
from devrf.pipelines.health.rows import HealthRow, listed, row

RESTARTED = "times that training ran away and went back"
CONTRADICTED = "share of what moves whose flow the pictures contradict"
MOVED = "largest offset of a clock, by what moves"
MOVED_MS = 10.0  # at 1 m/s a centimetre
MOSTLY_SHADED = 0.5  # of what movers gain; rolling things and cast shadows take a quarter
TEST_CLOCK = "largest offset of a test camera's clock, by what moves"
MENDED = (RESTARTED, CONTRADICTED, MOVED)
"""First words of the rows which say that training mended something: the cause is real, the loss may not be."""


@listed
def restart_rows(metrics: Mapping[str, Any]) -> Iterator[HealthRow]:
    """Whether training ran away and was restarted; and what of the motion had to be left as it was."""
    if metrics["rate"] < 1:
        yield row(
            RESTARTED,
            float(metrics["restarts"]),
            warn_above=0.0,
            remedy="Steps were too large and were made smaller (down to "
            f"{metrics['rate']:.2g} times); the result may stand. If it happens again, look at "
            "poses and clocks in the report.",
        )
    if metrics.get("keys_left"):
        yield row(
            "key times at which training the motion made it worse",
            float(metrics["keys_left"]),
            warn_above=0.0,
            remedy="Their motion was left as it was before: cameras contradict one another there. Look at poses "
            "and clocks in the report, and at what comes into view or leaves it at these times.",
        )


def flow_rows(contradicted: Mapping[str, float]) -> list[HealthRow]:
    """Whether pictures bear the flow out where anything moves; none where none was asked."""
    if not contradicted:
        return []
    worst = max(contradicted, key=lambda name: contradicted[name])
    return [
        row(
            f"{CONTRADICTED}, worst camera ({worst})",
            contradicted[worst],
            warn_above=MOSTLY_CONTRADICTED,
            remedy="The flow of such a camera does not count in training, so the motion rests on colours alone there. "
            "Run again with --force flow, or film with a higher frame rate and more texture; of a data set that brings "
            "its flow look at the direction, the order and the size of its vectors.",
        )
    ]


LOST_MOMENTS = 2.0  # in a row: as many pictures, of a clip that is not very long


@listed
def mover_rows(metrics: Mapping[str, Any]) -> Iterator[HealthRow]:
    """Whether tracked parts explain what changes; none where motion is a field."""
    if "movers_gain_db" not in metrics:
        return
    gain, unshaded = metrics["movers_gain_db"], metrics["movers_unshaded_gain_db"]
    yield row(
        "share of the gain of movers that is shading",
        100 * (1 - unshaded / gain) if gain > 0 else 100.0,
        "%",
        warn_above=100 * MOSTLY_SHADED,
        remedy="Brightness that changes explains what motion should: keep lights still and people's shadows out of "
        "the pictures; look at the film whether things move as in the clips, and give what moves more texture.",
    )
    worst = max(metrics["rigid_parts"], key=lambda part: part["longest_lost"])
    at = ", ".join(f"{x:.2f}" for x in worst["at"])
    yield row(
        "longest time that a moving part is lost",
        float(worst["longest_lost"]),
        "moments",
        warn_above=LOST_MOMENTS,
        remedy=f"Pictures show something else where a part should be that rests around ({at}): it goes on with what "
        "is around it, which may be wrong. Film at a higher rate, with a shorter exposure and more light; give "
        "what moves fast more texture, and let two cameras see it at all times.",
    )


def moved_clock_rows(offsets_s: Mapping[str, float]) -> list[HealthRow]:
    """Whether clocks were moved because what moves is seen elsewhere on its way than they say."""
    return _largest_offset(
        MOVED,
        offsets_s,
        "Training took pictures later than sync says: {every}. Set the lag of {name} in calibration.sync.av_lag_s or "
        "true times in capture.timestamps, or clap near the middle of the scene.",
    )


def unknown_clock_rows(clocks: Mapping[str, Mapping[str, Any]]) -> list[HealthRow]:
    """Whether a test camera is filmed at other times than its clock says, which is not known well."""
    return _largest_offset(
        TEST_CLOCK,
        {name: clock["offset_s"] for name, clock in clocks.items() if clock["offset_s"] is not None},
        "The model shows what moves as these test cameras saw it later than sync says: {every}. Test views are scored "
        "by the clocks as they were calibrated, and again with these (test_moving_retimed). Set the lag of {name} in "
        "calibration.sync.av_lag_s or true times in capture.timestamps, or record sound.",
    )


def _largest_offset(check: str, offsets_s: Mapping[str, float], remedy: str) -> list[HealthRow]:
    """A row on the largest offset, if there is any; its remedy names that camera, and every offset."""
    if not offsets_s:
        return []
    name = max(offsets_s, key=lambda camera: abs(offsets_s[camera]))
    every = ", ".join(f"{camera} {1e3 * offset_s:+.0f} ms" for camera, offset_s in offsets_s.items())
    return [
        row(
            f"{check} ({name})",
            1e3 * abs(offsets_s[name]),
            "ms",
            warn_above=MOVED_MS,
            remedy=remedy.format(name=name, every=every),
        )
    ]
