"""Precision and recall of what the pipeline says, on made-up results."""

from typing import Any

import pytest

from devrf.lab.bench.stability.case import Complaint, Result
from devrf.lab.bench.stability.points import points
from devrf.lab.bench.stability.precision_recall import PrecisionRecall, heard

BLUR = Complaint("ingest", "sharpness", "warn", 3.0, "sharpness")
NO_SCALE = Complaint("rig", "scale", "warn", "arbitrary scale", "scale")
CALM = [Result("undisturbed", 0.0, 0, psnr_moving=25.0, baseline=20.0, complaints=(NO_SCALE,))]


def case(axis: str, severity: int, psnr: float | None, spoken: bool, **more: Any) -> Result:
    rest: dict[str, Any] = {"psnr_moving": None if psnr is None else float(psnr), "baseline": 20.0} | more
    complaints = (NO_SCALE, BLUR) if spoken else (NO_SCALE,)
    return Result(axis, float(severity), 0, complaints=complaints, **rest)


def known(*cases: Result) -> PrecisionRecall:
    results = {name: [c for c in cases if c.axis == name] for name in dict.fromkeys(c.axis for c in cases)}
    return heard(results, CALM, {name: points(of_axis, CALM) for name, of_axis in results.items()})


def test_recall_asks_the_axes_that_break() -> None:
    found = known(
        case("early", 1, 24, True), case("early", 2, 20.5, False),
        case("at", 1, 24.8, False), case("at", 2, 20.5, True),
        case("late", 1, 20.5, False), case("late", 2, 20, True),
        case("never", 1, 20.5, False),
        case("whole", 1, 24.9, False),
    )  # fmt: skip
    assert found.broken == ("early", "at", "late", "never") and found.missed == ("late", "never")
    assert found.recall == 0.5


def test_precision_asks_the_cases_with_complaints() -> None:
    """0.5 dB is lost, or 0.4; a case that was stopped has lost everything."""
    found = known(
        case("a", 1, 24.5, True), case("a", 2, 24.6, True), case("a", 3, None, False, stopped="rig: no points"),
        case("b", 1, 20.0, False),
    )  # fmt: skip
    assert found.spoken == ("a 1, seed 0", "a 2, seed 0", "a 3, seed 0")
    assert found.unfounded == ("a 2, seed 0",) and found.precision == pytest.approx(2 / 3)
    assert found.alarms == ("rig: scale",)


def test_a_complaint_before_the_axis_breaks_is_early() -> None:
    """Noticed at 1, broken at 2; of `whole`, which never breaks, the same complaint is no early one."""
    found = known(
        case("early", 1, 24.8, True), case("early", 2, 20, True),
        case("whole", 1, 24.8, True), case("whole", 2, 24.8, True),
    )  # fmt: skip
    assert found.unfounded == ("early 1, seed 0", "whole 1, seed 0", "whole 2, seed 0")
    assert found.early == ("early 1, seed 0",)
    assert (found.precision, found.precision_or_early) == (0.25, 0.5)


def test_damage_that_training_mended_is_no_false_alarm() -> None:
    """It is noticed, but no case of precision; together with another complaint it is one."""
    mended = Complaint("canonical", "times that training ran away", "warn", 2.0, "training-mended")

    def case_of(axis: str, *complaints: Complaint) -> Result:
        return Result(axis, 1.0, 0, psnr_moving=25.0, baseline=20.0, complaints=(NO_SCALE, *complaints))

    found = known(case_of("mended", mended), case_of("more", mended, BLUR), case("hurt", 1, 24, True))
    assert found.spoken == ("more 1, seed 0", "hurt 1, seed 0") and found.unfounded == ("more 1, seed 0",)
    assert points([case_of("mended", mended)], CALM).notice == 1


def test_other_test_views_are_judged_by_what_motion_gains_in_them() -> None:
    """22 dB over 17 at rest gain as much as 25 over 20."""
    assert known(case("anew", 1, 22.0, True, baseline=17.0, films_anew=True)).precision == 0.0
    assert known(case("anew", 1, 22.0, True, baseline=19.0, films_anew=True)).precision == 1.0


def test_where_nothing_breaks_and_nothing_is_said_there_is_nothing_to_share() -> None:
    found = known(case("whole", 1, 24.9, False))
    assert (found.recall, found.precision) == (None, None)
