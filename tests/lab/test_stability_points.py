"""Where an axis breaks and where it is noticed, on made-up results; axes by name and by severity."""

from dataclasses import replace
from typing import Any

import pytest

from devrf.capture.measure import Verdict
from devrf.lab.bench.stability.axes import AXES, GROUPS, axes_of
from devrf.lab.bench.stability.case import Complaint, Result
from devrf.lab.bench.stability.points import bar_db, fails, points, said

BLUR = Complaint("ingest", "sharpness", "warn", 3.0, "sharpness")
LOUD = Complaint("ingest", "sharpness", "fail", 9.0, "sharpness")
NO_SCALE = Complaint("rig", "scale", "warn", "arbitrary scale", "scale")


def result(severity: float, psnr: float | None, *complaints: Complaint, seed: int = 0, **more: Any) -> Result:
    return Result(
        "axis", severity, seed, psnr_moving=psnr, baseline=20.0, complaints=(NO_SCALE, *complaints), **more
    )


CALM = [result(0.0, 25.0)]


def test_the_failure_point_is_where_motion_gains_less_than_it_must_over_the_undisturbed_scene_at_rest() -> (
    None
):
    assert bar_db(CALM) == 21.0
    found = points([result(1.0, 24.0), result(2.0, 20.9), result(4.0, 19.0)], CALM)
    assert (found.failure, found.notice) == (2, None)
    assert points([result(1.0, 21.0)], CALM).failure is None  # at the bar is not below it


def test_a_case_that_was_stopped_has_failed_and_has_said_so() -> None:
    found = points([result(1.0, 24.0), result(2.0, None, stopped="rig: no points")], CALM)
    assert (found.failure, found.notice) == (2, 2)
    assert found.notices == ("stopped by rig: no points",)


def test_a_row_counts_where_the_undisturbed_case_does_not_show_it_so_loudly() -> None:
    assert said(result(1.0, 24.0), CALM[0]) == ()
    assert said(result(1.0, 24.0, BLUR), CALM[0]) == ("ingest: sharpness",)
    shown = result(0.0, 25.0, BLUR)
    assert said(result(1.0, 24.0, BLUR), shown) == ()
    assert said(result(1.0, 24.0, LOUD), shown) == ("ingest: sharpness",)
    found = points([result(1.0, 24.0), result(2.0, 23.0, BLUR), result(4.0, 20.0, LOUD)], CALM)
    assert (found.failure, found.notice, found.notices) == (4, 2, ("ingest: sharpness",))


def test_the_same_complaint_about_another_camera_is_no_new_one() -> None:
    def about(camera: str, verdict: Verdict = "warn") -> Complaint:
        return Complaint("scene", f"points in view ({camera})", verdict, 1.0, "camera-points")

    shown = result(0.0, 25.0, about("cam0", "fail"), about("cam1"))
    assert said(result(1.0, 24.0, about("cam4", "fail")), shown) == ()
    softly = result(0.0, 25.0, about("cam0"))
    assert said(result(1.0, 24.0, about("cam4")), softly) == ()
    assert said(result(1.0, 24.0, about("cam4", "fail")), softly) == ("scene: points in view (cam4)",)


def test_half_of_the_seeds_decide() -> None:
    calm = [result(0.0, 25.0, seed=n) for n in range(4)]

    def cases(bad: int) -> list[Result]:
        return [
            result(1.0, 20.0 if n < bad else 24.0, *([BLUR] if n < bad else []), seed=n) for n in range(4)
        ]

    assert (points(cases(1), calm).failure, points(cases(1), calm).notice) == (None, None)
    assert (points(cases(2), calm).failure, points(cases(2), calm).notice) == (1, 1)


def test_where_the_undisturbed_result_is_worth_nothing_only_stops_count() -> None:
    poor = [result(0.0, 20.5)]
    assert bar_db(poor) is None
    assert not fails(result(1.0, 5.0), None)
    assert fails(result(1.0, None, stopped="flow: no"), None)


@pytest.mark.parametrize(
    ("count", "chosen"),
    [
        (None, (1.0, 2.0, 4.0, 8.0)),
        (9, (1.0, 2.0, 4.0, 8.0)),
        (3, (1.0, 2.0, 8.0)),
        (2, (2.0, 8.0)),
        (1, (8.0,)),
    ],
)
def test_some_severities_are_spread_and_hold_the_worst(count: int | None, chosen: tuple[float, ...]) -> None:
    axis = replace(AXES["seeds"], severities=(1.0, 2.0, 4.0, 8.0))
    assert axis.some(count) == chosen


def test_a_group_stands_for_its_axes_and_none_comes_twice() -> None:
    assert axes_of(["flow_zero", "flow"]) == ["flow_zero", "flow_wrong", "flow_noise"]
    assert set(axes_of(list(GROUPS))) == set(AXES) and not set(GROUPS) & set(AXES)


def test_where_something_else_is_filmed_its_own_scene_at_rest_is_the_bar() -> None:
    bar = bar_db(CALM)
    assert bar == 21.0
    harder = replace(result(1.0, 18.0), baseline=16.0)
    assert fails(harder, bar) and not fails(replace(harder, films_anew=True), bar)
    assert fails(replace(harder, films_anew=True, psnr_moving=16.9), bar)


def test_what_comes_back_when_the_damage_is_lessened() -> None:
    found = points([result(1.0, 24.0), result(2.0, 23.0), result(4.0, 20.0)], CALM)
    assert (found.failure, found.lessened, found.lessened_db) == (4, 2, 23)
    at_once = points([result(1.0, 20.0)], CALM)
    assert (at_once.failure, at_once.lessened, at_once.lessened_db) == (1, 0, 25)  # undamaged
    assert points([result(1.0, 24.0)], CALM).lessened is None


def test_severities_rise() -> None:
    for axis in AXES.values():
        assert list(axis.severities) == sorted(set(axis.severities)) and 3 <= len(axis.severities) <= 4
