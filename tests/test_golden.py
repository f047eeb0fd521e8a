"""The golden values: a value beyond its bound is told, and so is a row that vanished, but not one that is listed."""

import json
import math

import numpy as np
import pytest
from benchmarks.golden import CASES, GONE, RECORDED, bound_of, differences
from benchmarks.golden_facts import turned_deg
from scipy.spatial.transform import Rotation

NOTHING = {"gone": {}, "new": {}, "renamed": []}
ROW = "health.rig.board before cam0"


def told(was: dict, now: dict, spread: dict | None = None, listed: dict = NOTHING) -> list[str]:
    return [row.what for row in differences(was, now, spread or {}, listed, "example")]


@pytest.mark.parametrize(
    "name, was, good, bad",
    [
        ("test_moving.psnr", 26.0, 26.09, 25.89),
        ("base.test.psnr", 26.0, 25.91, 26.11),
        ("test.ssim", 0.8, 0.804, 0.807),
        ("clock.cam1.offset_s", -0.1, -0.1009, -0.1012),
        ("truth.rig_rotation_deg", 0.06, 0.075, 0.085),
        ("truth.sync_ms", 0.2, 1.1, 1.3),
        ("mesh.ply_vertex", 1000, 1019, 1021),
        ("exit.run", 0, 0, 3),
        ("five-sections.mistakes", 5, 5, 4),
        ("test.views", 40, 40, 39),
        (ROW, "ok", "ok", "warn"),
        (ROW, "ok ok", "ok ok", "ok"),
        ("test.psnr", None, None, 26.0),
    ],
)
def test_a_value_beyond_its_bound_is_told(name: str, was: object, good: object, bad: object) -> None:
    assert told({name: was}, {name: good}) == []
    assert told({name: was}, {name: bad}) == [f"example/{name}"]


def test_twice_the_spread_widens_a_bound_and_never_narrows_it() -> None:
    assert bound_of("test.psnr", 26.0, 0.2) == 0.4
    assert bound_of("test.psnr", 26.0, 0.01) == 0.1
    assert told({"test.psnr": 26.0}, {"test.psnr": 26.3}, {"test.psnr": 0.2}) == []


def test_a_row_that_vanished_is_told_unless_its_reason_is_listed() -> None:
    assert told({ROW: "ok"}, {}) == [f"example/{ROW}"]
    listed = NOTHING | {"gone": {"*/health.rig.board before *": "nobody read it"}}
    assert told({ROW: "ok"}, {}, listed=listed) == []
    assert told({"health.rig.scale": "ok"}, {}, listed=listed) == ["example/health.rig.scale"]


def test_a_row_that_came_is_told_unless_its_reason_is_listed() -> None:
    assert told({}, {ROW: "ok"}) == [f"example/{ROW}"]
    assert told({}, {ROW: "ok"}, listed=NOTHING | {"new": {f"example/{ROW}": "it is new"}}) == []


def test_a_renamed_row_keeps_its_verdict() -> None:
    was = {ROW: "ok", "health.rig.board before cam1": "warn"}
    listed = NOTHING | {"renamed": [["board before cam\\d", "board", "one row for all cameras"]]}
    assert told(was, {"health.rig.board": "ok warn"}, listed=listed) == []
    assert told(was, {"health.rig.board": "ok ok"}, listed=listed) == ["example/health.rig.board"]


def test_poses_are_compared_after_the_world_was_turned() -> None:
    poses = Rotation.random(6, rng=np.random.default_rng(0))

    def written(turns: Rotation) -> dict[str, str]:
        return {f"cam{n}": " ".join(map(str, r)) for n, r in enumerate(turns.as_rotvec())}

    world = poses * Rotation.from_rotvec([0.3, -1.2, 0.5])
    bumped = Rotation.concatenate([Rotation.from_euler("x", 0.1, degrees=True) * world[0], world[1:]])
    assert turned_deg(written(poses), written(world)) < 1e-6
    assert 0.06 < turned_deg(written(poses), written(bumped)) < 0.1  # the others take their share
    assert turned_deg(written(poses), written(poses[:5])) == math.inf
    assert told({"poses.rig": written(poses)}, {"poses.rig": written(bumped)}) == ["example/poses.rig"]


def test_what_every_commit_is_checked_by_is_recorded_and_every_listed_change_has_a_reason() -> None:
    recorded, listed = json.loads(RECORDED.read_text()), json.loads(GONE.read_text())
    assert {case.name for case in CASES if case.subset} <= recorded.keys() <= {case.name for case in CASES}
    reasons = [
        *listed["gone"].values(),
        *listed["new"].values(),
        *(reason for *_, reason in listed["renamed"]),
    ]
    assert all(len(reason) > 10 for reason in reasons)
    broken = recorded["broken"]["values"]
    assert sum(value == 2 for name, value in broken.items() if name.endswith(".exit")) >= 50
