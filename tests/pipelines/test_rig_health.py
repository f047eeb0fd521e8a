"""Rows of the stage `rig`: each fault fires its row with its remedy, a healthy rig fires none."""

from dataclasses import replace

import numpy as np
import pytest
from tests.judged import fired

from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import BoardRig, rig_from_board
from devrf.calibration.rigs.board_views import TimedView
from devrf.calibration.rigs.bump import Bump
from devrf.calibration.rigs.cross_check import check_rig, cross_check
from devrf.calibration.rigs.graph import Link, camera_graph
from devrf.calibration.rigs.joint import disagreement
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.lab.bench.accuracy.synthetic_rig import (
    SPEC,
    SyntheticRig,
    claimed,
    synthetic_cameras,
    synthetic_views,
)
from devrf.pipelines.health.judge import judge
from devrf.pipelines.health.rig_rows import (
    bump_measures,
    graph_measures,
    joint_measures,
    route_measures,
    scale_measures,
    sweep_measures,
)

SMALL = SyntheticRig(cameras=3, spread_deg=70.0, duration_s=12.0)
Views = dict[str, list[TimedView]]


def session(
    seed: int = 0, delay_s: dict[str, float] | None = None, rig: SyntheticRig = SMALL
) -> tuple[dict[str, Camera], Views]:
    rng = np.random.default_rng(seed)
    cameras = synthetic_cameras(rig, rng)
    return cameras, synthetic_views(rig, cameras, rng, delay_s)


def calibrated(cameras: dict[str, Camera], off: float = 0.0, std: float = 0.005) -> dict[str, Intrinsics]:
    rng = np.random.default_rng(7)
    return {n: claimed(c, rng, off, std, 0.0) for n, c in cameras.items()}


@pytest.fixture(scope="module")
def healthy() -> tuple[dict[str, Camera], Views, BoardRig]:
    cameras, views = session()
    known = calibrated(cameras)
    return cameras, views, rig_from_board(views, SPEC, known, known)


def test_a_healthy_rig_fires_none_and_is_where_it_is(healthy):
    """Noise 0.3 px, 36 instants of three cameras at 2.5 m: standard deviations of about 1 mm; 4 of them."""
    cameras, views, rig = healthy
    known = calibrated(cameras)
    assert fired(joint_measures(rig, cross_check(views, SPEC, known, known))) == {}
    problem = rig.solution.problem
    index = {n: c for c, n in enumerate(rig.views.names)}
    found = {n: RigCamera(c, "board") for n, c in rig.cameras.items()}
    whole = Rig(found, Scale(True, "board", 1.0, None), "board", camera_graph(problem, index))
    assert fired(graph_measures(whole.graph, whole)) == {}
    for n, true in list(cameras.items())[1:]:
        std = np.sqrt(np.diag(rig.solution.pose_covariance[index[n]]))
        turn = rotation_angle_deg(rig.cameras[n].cam_from_world[:, :3], true.cam_from_world[:, :3])
        assert turn < 4 * np.degrees(np.linalg.norm(std[:3])) < 0.2
        assert np.linalg.norm(rig.cameras[n].centre - true.centre) < 4 * np.linalg.norm(std[3:]) < 0.01


def test_a_late_clock_is_found_and_named():
    """C17: a corner moves 0.5 m/s here, 250 px/s: over 36 instants 40 ms are known to a millisecond or so."""
    cameras, views = session(delay_s={"cam1": 0.04})
    known = calibrated(cameras)
    rig = rig_from_board(views, SPEC, known, known)
    assert rig.delay_s["cam1"] == pytest.approx(0.04, abs=4e-3)
    assert list(fired(joint_measures(rig, None))) == ["clocks-disagree cam1"]


def test_lengths_that_miss_the_print_are_named(healthy):
    """C25: corners 2 % too far apart, whatever the pictures say."""
    cameras, views, rig = healthy
    check = check_rig(rig.cameras, rig.delay_s, views, SPEC)
    assert check is not None and check.error_percent < 0.2
    assert list(fired(joint_measures(rig, replace(check, lengths_m=1.02 * check.lengths_m)))) == [
        "board-lengths"
    ]


def test_a_board_at_one_distance_leaves_focal_lengths_as_calibrated():
    rig = SyntheticRig(cameras=2, spread_deg=30.0, depth_m=0.1, width_m=0.4, duration_s=8.0)
    cameras, views = session(rig=rig)
    known = calibrated(cameras)
    found = rig_from_board(views, SPEC, known, known)
    assert found.shallow == ("cam0", "cam1")
    for n, k in known.items():
        assert k.std is not None and abs(found.cameras[n].K[0, 0] - k.K[0, 0]) < 2 * k.std[0]


def placed(**yaw_deg: float) -> Rig:
    """Cameras that look along the given directions."""
    cameras = {}
    for name, angle in yaw_deg.items():
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        cameras[name] = RigCamera(
            Camera(64, 48, np.diag([50.0, 50, 1]), np.column_stack([R, np.zeros(3)])), "board"
        )
    return Rig(cameras, ARBITRARY, "board")


def test_weak_leaf_and_opposed_cameras_are_named():
    """C14, C15, C16."""
    rig = placed(a=0.0, b=40.0, c=170.0)
    links = (Link("a", "b", 150, 0), Link("b", "c", 300, 0), Link("a", "c", 0, 0))
    rows = [row for row in judge(graph_measures(links, rig)) if row.verdict == "warn"]
    assert [(row.about, row.value) for row in rows if not isinstance(row.value, str)] == [("a", 150)]
    assert " a and b " in rows[0].remedy
    leaf = next(row for row in rows if row.about == "c")
    assert str(leaf.value).endswith(" b") and "a faces it" in leaf.remedy and "both sides" in leaf.remedy
    few = (Link("a", "b", 40, 0), Link("b", "c", 300, 0), Link("a", "c", 0, 0))
    assert any(row.verdict == "fail" for row in judge(graph_measures(few, rig)))


GOOD = {
    "matches": 400,
    "verified": 250,
    "inlier_area": 0.5,
    "median_distance": 3.0,
    "axis_std": 0.003,
    "sideways_std": 0.001,
}


@pytest.mark.parametrize(
    ("change", "inliers", "code"),
    [
        ({}, 300, None),
        ({}, 60, "camera-points cam2"),  # C20
        ({"inlier_area": 0.1}, 300, "camera-points-crowded cam2"),  # C21
        ({"median_distance": 0.5}, 300, "camera-position cam2"),  # C22
        ({"verified": 30}, 300, "camera-matches cam2"),  # C20, C23
    ],
)
def test_faults_of_a_registration_are_named(change, inliers, code):
    camera = placed(cam2=0.0).cameras["cam2"].camera
    c = RigCamera(camera, "self", 0.05, 0.004, inliers, 0.5, GOOD | change)
    assert list(fired(sweep_measures("cam2", c))) == ([] if code is None else [code])
    assert fired(sweep_measures("cam2", replace(c, inliers=20)))["camera-points cam2"].verdict == "fail"


def test_routes_that_disagree_are_named(healthy):
    """C24: the board's cameras against the same, then with one turned by 1 degree about its own centre."""
    cameras, _, board = healthy
    sweep = {n: RigCamera(c, "self", 0.02, 0.002, 300, 0.5, GOOD) for n, c in cameras.items()}
    found, same = route_measures(disagreement(cameras, board.cameras), sweep, board, 1.0)
    assert fired(found) == {} and same
    touched = cameras["cam1"]
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ touched.cam_from_world[:, :3]
    other = cameras | {"cam1": replace(touched, cam_from_world=np.column_stack([R, -R @ touched.centre]))}
    rows = fired(route_measures(disagreement(other, board.cameras), sweep, board, 1.0)[0])
    assert "rig-routes cam1, rotation, degrees" in rows and all(row.remedy for row in rows.values())


def test_a_bumped_camera_is_named_with_the_time():
    """C19."""
    row = fired(bump_measures("cam3", Bump(0.8, 41.3, 200)))["camera-bumped cam3"]
    assert row.verdict == "warn" and "cam3 " in row.remedy and "00:41.3" in row.remedy
    assert fired(bump_measures("cam3", Bump(0.1, 41.3, 200))) == {} and bump_measures("cam3", None) == []


def test_scales_that_disagree_are_named():
    """C3."""
    board = Scale(True, "board", 1.00, 1e-3)
    assert fired(scale_measures([board, Scale(True, "tape", 1.005, None)], board)) == {}
    row = judge(scale_measures([board, Scale(True, "tape", 1.04, None)], board))[0]
    assert row.verdict == "warn" and "board against tape: 4 % apart" in str(row.value)
    for unmeasured in (False, True):
        (row,) = fired(scale_measures([], ARBITRARY, unmeasured)).values()
        assert ("capture.board.square_m" in row.remedy) == unmeasured
