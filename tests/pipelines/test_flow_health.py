"""Which row each fault of the flow fires, and that a healthy clip fires none."""

from dataclasses import replace

import pytest

from devrf.flow.checks import FlowChecks
from devrf.pipelines.health.flow_rows import flow_measures
from devrf.pipelines.health.judge import judge

HEALTHY = FlowChecks(
    pairs=30,
    gaps=0,
    supported=0.9,
    valid=0.95,
    moving=0.1,
    moving_valid=0.9,
    unsure=0.05,
    round_trip_px=0.1,
    warp_ratio=0.3,
    large=0.0,
    shake_px=0.02,
    better_as=None,
)


@pytest.mark.parametrize("given", [False, True])
def test_a_healthy_clip_fires_nothing(given: bool) -> None:
    assert {row.verdict for row in judge(flow_measures({"cam0": HEALTHY, "cam1": HEALTHY}, given))} == {"ok"}


@pytest.mark.parametrize(
    ("fault", "verdict", "code", "remedy"),
    [
        ({"large": 0.1}, "warn", "flow-large", "flow.method: raft"),
        ({"unsure": 0.5}, "warn", "flow-unsure", ""),
        ({"moving_valid": 0.69}, "warn", "flow-moving", ""),
        ({"valid": 0.2}, "fail", "flow-consistent", ""),
        ({"valid": None}, "warn", "flow-consistent", "not measured"),
        ({"better_as": "forward"}, "fail", "flow-meaning", "direction"),
        ({"better_as": "next"}, "fail", "flow-meaning", "by one"),
        ({"better_as": "before"}, "fail", "flow-meaning", "by one"),
        ({"better_as": "full size"}, "fail", "flow-meaning", "ratio"),
        ({"warp_ratio": 1.2}, "fail", "flow-warping", ""),
        ({"shake_px": 0.4}, "warn", "flow-shake", ""),
        ({"gaps": 2}, "warn", "frames-dropped", "faster card"),
    ],
)
def test_each_fault_has_its_row(fault: dict, verdict: str, code: str, remedy: str) -> None:
    rows = judge(flow_measures({"cam0": HEALTHY, "cam1": replace(HEALTHY, **fault)}))
    (bad,) = [row for row in rows if row.verdict != "ok"]
    assert (bad.code, bad.verdict, bad.about) == (code, verdict, "cam1")
    assert bad.remedy and remedy in bad.remedy


@pytest.mark.parametrize("fault", [{"valid": 0.2}, {"warp_ratio": 1.2}])
def test_a_run_that_other_cameras_carry_is_not_refused(fault: dict) -> None:
    """What its flow contradicts does not count in training."""
    for poor, good, verdict in ((1, 2, "warn"), (1, 1, "fail"), (2, 2, "warn"), (2, 1, "fail")):
        checks = {f"poor{n}": replace(HEALTHY, **fault) for n in range(poor)}
        rows = judge(flow_measures(checks | {f"good{n}": HEALTHY for n in range(good)}))
        assert [row.verdict for row in rows if row.verdict != "ok"] == [verdict]


def test_what_cannot_be_told_is_not_asked() -> None:
    quiet = replace(HEALTHY, moving_valid=None, warp_ratio=None, shake_px=None)
    rows = judge(flow_measures({"cam0": quiet}))
    assert [(row.code, row.verdict) for row in rows] == [("flow-consistent", "ok")]
    assert list(flow_measures({})) == []
