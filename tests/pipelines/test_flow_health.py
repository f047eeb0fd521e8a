"""Which row each fault of the flow fires, and that a healthy clip fires none."""

from dataclasses import replace

import pytest

from devrf.flow.checks import FlowChecks
from devrf.pipelines.health.flow import health

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
    brightness_step=0.005,
    shake_px=0.02,
    better_as=None,
)


@pytest.mark.parametrize("given", [False, True])
def test_a_healthy_clip_fires_nothing(given: bool) -> None:
    assert {row.verdict for row in health({"cam0": HEALTHY, "cam1": HEALTHY}, given)} == {"ok"}


@pytest.mark.parametrize(
    ("fault", "verdict", "says", "remedy"),
    [
        ({"brightness_step": 0.05}, "warn", "change of brightness", ""),
        ({"large": 0.1}, "warn", "beyond 1/8 of the width", "flow.method: raft"),
        ({"unsure": 0.5}, "warn", "too little texture", ""),
        ({"moving_valid": 0.69}, "warn", "consistent share of what moves", ""),
        ({"valid": 0.2}, "fail", "consistent share of what can be followed", ""),
        ({"better_as": "forward"}, "fail", "what the flow is (cam1)", "direction"),
        ({"better_as": "next"}, "fail", "what the flow is (cam1)", "by one"),
        ({"better_as": "before"}, "fail", "what the flow is (cam1)", "by one"),
        ({"better_as": "full size"}, "fail", "what the flow is (cam1)", "ratio"),
        ({"warp_ratio": 1.2}, "fail", "what warping leaves", ""),
        ({"shake_px": 0.4}, "warn", "movement of the whole picture", ""),
        ({"gaps": 2}, "warn", "gaps in the clips", ""),
    ],
)
def test_each_fault_has_its_row(fault: dict, verdict: str, says: str, remedy: str) -> None:
    rows = health({"cam0": HEALTHY, "cam1": replace(HEALTHY, **fault)})
    bad = [row for row in rows if row.verdict != "ok"]
    assert [row.verdict for row in bad] == [verdict]
    assert says in bad[0].check and bad[0].remedy and remedy in bad[0].remedy
    assert "cam1" in f"{bad[0].check} {bad[0].value}"


def test_what_cannot_be_told_is_not_asked() -> None:
    quiet = replace(HEALTHY, moving_valid=None, warp_ratio=None, brightness_step=None, shake_px=None)
    rows = health({"cam0": quiet})
    assert [row.check for row in rows][1:] == ["motion"] and {row.verdict for row in rows} == {"ok"}
