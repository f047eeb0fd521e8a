"""Fixed cameras into a synthetic sweep, a rig from a board, metric scale, and rig.json."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.intrinsics import Intrinsics, from_vector, guess
from devrf.calibration.rigs import sweep_route
from devrf.calibration.rigs.board_route import rig_from_board
from devrf.calibration.rigs.board_views import TimedView
from devrf.calibration.rigs.clean_picture import clean_pictures
from devrf.calibration.rigs.graph import camera_graph
from devrf.calibration.rigs.joint import adjust_together, disagreement, rig_in_world
from devrf.calibration.rigs.registration import camera_of, register
from devrf.calibration.rigs.rig import Rig, RigCamera, Scale, read_rig, write_rig
from devrf.calibration.rigs.scale import combined, scale_from_board, scale_from_distances
from devrf.calibration.rigs.sweep_route import FixedCameraInput, rig_from_sweep
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.capture.rest import Rest
from devrf.capture.system.errors import CaptureError, HealthError
from devrf.capture.view_axes import look_at
from devrf.pipelines.health.judge import judge
from devrf.pipelines.stages.rig import rig_routes
from devrf.pipelines.stages.rig.joint_clips import JointViews
from devrf.pipelines.stages.rig.rig_job import RigJob

SIZE = (640, 480)
VECTOR = np.array([520.0, 520.0, 324.0, 236.0, -0.06, 0.0, 0.0, 0.0, 0.0])
SPEC = BoardSpec("charuco", (7, 5), 0.05, 0.0375)


def ring(count: int, radius: float = 3.0, height: float = 0.5, turn: float = 0.0) -> list[Camera]:
    """Cameras around the origin."""
    k = from_vector(*SIZE, VECTOR)
    out = []
    for angle in turn + np.linspace(0, 2 * np.pi, count, endpoint=False):
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height * (1 + np.sin(2 * angle))])
        out.append(k.at(look_at(centre, np.zeros(3))))
    return out


def synthetic_sweep(seed: int = 0, points: int = 700, noise_px: float = 0.3) -> tuple[SweepModel, np.ndarray]:
    """A registered sweep: 16 cameras, points with descriptors of their own; and the points' clean descriptors."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1.2, 1.2, (points, 3))
    look = rng.integers(0, 160, (points, 128)).astype(np.uint8)
    cameras = ring(16)
    obs = [(p, c) for c in range(16) for p in rng.choice(points, points // 2, replace=False)]
    obs_point, obs_image = np.array(obs).T
    xy = np.array([cameras[c].project(xyz[p]) for p, c in obs])
    return (
        SweepModel(
            names=tuple(f"static/{n:06d}.png" for n in range(16)),
            cameras=tuple(cameras),
            xyz=xyz,
            rgb=np.zeros((points, 3), dtype=np.uint8),
            error_px=np.full(points, 0.3),
            obs_point=obs_point,
            obs_image=obs_image,
            obs_xy=xy + noise_px * rng.standard_normal(xy.shape),
            obs_descriptor=described(look[obs_point], rng),
            report={},
        ),
        look,
    )


def described(look: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Descriptors as another picture would see them."""
    return np.clip(look + rng.normal(0, 8, look.shape), 0, 255).astype(np.uint8)


def features_of(camera: Camera, model: SweepModel, look: np.ndarray, seed: int, share: float = 0.5) -> tuple:
    """Features of a picture: some of the points with 0.3 px noise, and as many that belong to nothing."""
    rng = np.random.default_rng(seed)
    seen = np.flatnonzero(rng.random(len(look)) < share)
    xy = camera.project(model.xyz[seen]) + 0.3 * rng.standard_normal((len(seen), 2))
    other = rng.uniform(0, SIZE, (len(look) // 2, 2))
    noise = rng.integers(0, 160, (len(other), 128)).astype(np.uint8)
    return (
        np.concatenate([xy, other]).astype(np.float32),
        np.concatenate([described(look[seen], rng), noise]),
    )


def fixed_cameras() -> dict[str, Camera]:
    """Three cameras between the sweep's."""
    return {f"cam{n}": c for n, c in enumerate(ring(3, radius=2.6, height=0.8, turn=0.3))}


def errors(found: Camera, true: Camera) -> tuple[float, float]:
    """Rotation in degrees, position relative to the distance to the origin."""
    turn = rotation_angle_deg(found.cam_from_world[:, :3], true.cam_from_world[:, :3])
    return turn, float(np.linalg.norm(found.centre - true.centre) / np.linalg.norm(true.centre))


@pytest.fixture(scope="module")
def sweep() -> tuple[SweepModel, np.ndarray]:
    return synthetic_sweep()


def test_registration_with_known_intrinsics(sweep):
    model, look = sweep
    true = fixed_cameras()["cam1"]
    xy, descriptors = features_of(true, model, look, 5)
    found, inliers = register(xy, descriptors, model, from_vector(*SIZE, VECTOR), known=True)
    assert found is not None and inliers > 250
    turn, position = errors(found.camera, true)
    assert turn < 0.02 and position < 0.0005


def test_registration_finds_the_focal_length(sweep):
    model, look = sweep
    true = fixed_cameras()["cam2"]
    xy, descriptors = features_of(true, model, look, 6)
    found, inliers = register(xy, descriptors, model, guess(*SIZE), known=False)
    assert found is not None and inliers > 250
    assert found.camera.K[0, 0] == pytest.approx(VECTOR[0], rel=0.01)
    turn, position = errors(found.camera, true)
    assert turn < 0.5 and position < 0.01  # the principal point is 4 px off: 0.4 degrees


def test_registration_with_pixels_that_are_not_square(sweep):
    """HDV: pixels of 4:3, so that fy is 4/3 of fx."""
    model, look = sweep
    xy, descriptors = features_of(fixed_cameras()["cam2"], model, look, 6)
    size = (SIZE[0] * 3 // 4, SIZE[1])
    narrow = (xy * [0.75, 1.0]).astype(np.float32)
    found, inliers = register(narrow, descriptors, model, guess(*size, None, 4 / 3), known=False)
    assert found is not None and inliers > 250
    assert np.diag(found.camera.K)[:2] == pytest.approx([0.75 * VECTOR[0], VECTOR[0]], rel=0.01)
    assert errors(found.camera, fixed_cameras()["cam2"])[0] < 0.5


@pytest.mark.parametrize("board", [True, False])
def test_rig_from_sweep(sweep, tmp_path, monkeypatch, board):
    model, look = sweep
    truth = fixed_cameras()
    features = {f"{n}_clip": features_of(c, model, look, 10 + i) for i, (n, c) in enumerate(truth.items())}
    monkeypatch.setattr(sweep_route, "_features", lambda *_: features)
    std = np.array([1.0, 1.0, 0.5, 0.5, 2e-3, 0, 0, 0, 0])
    rng = np.random.default_rng(1)
    known = from_vector(*SIZE, VECTOR + std * rng.standard_normal(9), std)
    inputs = [
        FixedCameraInput(n, [tmp_path / f"{n}_clip.png"], *SIZE, known if board else None) for n in truth
    ]
    found = rig_from_sweep(model, inputs, tmp_path).cameras
    for name, true in truth.items():
        c = found[name]
        turn, position = errors(c.camera, true)
        assert turn < (0.15 if board else 0.5) and position < (0.002 if board else 0.015)
        assert c.intrinsics_source == ("board" if board else "self")
        assert c.inliers is not None and c.inliers > 250
        assert c.rotation_std_deg is not None and turn < 5 * c.rotation_std_deg
        assert c.details["inlier_area"] > 0.3


@pytest.mark.parametrize("cameras", [2, 3])
def test_a_camera_that_shares_no_view_is_left_out_where_others_are_enough(
    sweep, tmp_path, monkeypatch, cameras
):
    model, look = sweep
    truth = dict(list(fixed_cameras().items())[:cameras])
    features = {f"{n}_clip": features_of(c, model, look, 10 + i) for i, (n, c) in enumerate(truth.items())}
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 160, (400, 128)).astype(np.uint8)
    features["cam1_clip"] = (rng.uniform(0, SIZE, (400, 2)).astype(np.float32), noise)
    monkeypatch.setattr(sweep_route, "_features", lambda *_: features)
    inputs = [
        FixedCameraInput(n, [tmp_path / f"{n}_clip.png"], *SIZE, from_vector(*SIZE, VECTOR)) for n in truth
    ]
    if cameras == 2:
        with refused("rig-unlinked-camera", "cam1", "need 30", kind=HealthError):
            rig_from_sweep(model, inputs, tmp_path)
        return
    found = rig_from_sweep(model, inputs, tmp_path)
    assert list(found.left_out) == ["cam1"] and "need 30" in found.left_out["cam1"]
    assert list(found.cameras) == list(found.registrations) == ["cam0", "cam2"]
    assert all(errors(found.cameras[n].camera, truth[n])[0] < 0.15 for n in ("cam0", "cam2"))


def test_clean_pictures_drop_what_moves(tmp_path):
    files = []
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 255, (40, 60, 3)).astype(np.uint8)
    for n in range(9):
        picture = scene.copy()
        picture[10:20, 5 * n : 5 * n + 6] = 255
        files.append(tmp_path / f"{n}.png")
        cv2.imwrite(str(files[-1]), picture)
    rest, clip = clean_pictures("cam0", files, "start", tmp_path)
    np.testing.assert_array_equal(cv2.imread(str(clip)), scene)
    assert (cv2.imread(str(rest)) != scene).any()
    with refused("pictures-none", "'cam0'", kind=CaptureError):
        clean_pictures("cam0", [], "start", tmp_path)


@pytest.mark.parametrize(
    ("rest", "written"),
    [
        ("auto", {"start": 0, "end": 6, "clip": None}),
        ("start", {"start": 0, "clip": None}),
        ("middle", {"middle": 3, "clip": None}),
        ("end", {"end": 6, "clip": None}),
        ("none", {"clip": None}),
    ],
)
def test_clean_pictures_are_those_of_which_one_may_show_the_rest(
    tmp_path: Path, rest: Rest, written: dict[str, int | None]
) -> None:
    """Each picture is brighter than the one before; the median of the three at the rest is that of their middle."""
    files = [tmp_path / f"{n}.png" for n in range(9)]
    for n, file in enumerate(files):
        cv2.imwrite(str(file), np.full((4, 6, 3), 20 * n, np.uint8))
    out = tmp_path / "clean"
    out.mkdir()
    found = clean_pictures("cam0", files, rest, out)
    assert [path.name for path in found] == [f"cam0_{label}.png" for label in written]
    assert sorted(out.iterdir()) == sorted(found)
    for path, first in zip(found, written.values(), strict=True):
        assert (cv2.imread(str(path)) == 20 * (4 if first is None else first + 1)).all()


def board_session(
    cameras: dict[str, Camera], instants: int = 16, gap_s: float = 0.0, seed: int = 0, noise_px: float = 0.15
) -> dict[str, list[TimedView]]:
    """A board carried on a smooth way before all cameras, which expose up to `gap_s` apart."""
    rng = np.random.default_rng(seed)
    views: dict[str, list[TimedView]] = {name: [] for name in cameras}
    corners = SPEC.corners - SPEC.corners.mean(0)
    for n in range(instants):
        for name, camera in cameras.items():
            t = 0.2 * n + gap_s * rng.random()
            place = 0.35 * np.array([np.sin(0.9 * t), np.cos(0.7 * t), 0.5 * np.sin(1.3 * t)])
            R = cv2.Rodrigues(np.array([0.5 * np.sin(t), 0.6 * np.cos(0.8 * t), 0.4 * t]))[0]
            xy = camera.project(corners @ (R @ np.diag([1, -1, -1])).T + place)
            inside = ((xy > 0) & (xy < SIZE)).all(1)
            if inside.sum() >= 6:
                noisy = (xy + noise_px * rng.standard_normal(xy.shape))[inside]
                views[name].append(TimedView(BoardView(n, np.flatnonzero(inside), noisy), t))
    return views


def above(count: int) -> dict[str, Camera]:
    """Cameras that look down on the board from one side."""
    k = from_vector(*SIZE, VECTOR)
    out = {}
    for n, angle in enumerate(np.linspace(-0.9, 0.9, count)):
        centre = 2.0 * np.array([np.sin(angle), 0.3 * np.cos(3 * n), 1.0])
        out[f"cam{n}"] = k.at(look_at(centre, np.zeros(3)))
    return out


def relative(cameras: dict[str, Camera], name: str) -> Camera:
    """The camera in the first one's frame."""
    first = next(iter(cameras.values()))
    return cameras[name].moved(np.linalg.inv(first.world_from_cam))


@pytest.mark.parametrize("gap_s", [0.0, 0.02])
def test_rig_from_board(gap_s):
    truth = above(4)
    std = np.array([3.0, 3.0, 2.0, 2.0, 5e-3, 0, 0, 0, 0])
    prior = {n: from_vector(*SIZE, VECTOR + 0.3 * std, std) for n in truth}
    found = rig_from_board(board_session(truth, gap_s=gap_s), SPEC, prior, prior)
    for name in list(truth)[1:]:
        ours, true = found.cameras[name], relative(truth, name)
        # the prior puts every principal point 0.6 px off: 0.09 degrees per camera and axis
        assert rotation_angle_deg(ours.cam_from_world[:, :3], true.cam_from_world[:, :3]) < 0.3
        assert np.linalg.norm(ours.centre - true.centre) < 0.015  # metres, at a distance of 2
    assert found.rms_px < 0.6
    assert found.gap_ms[1] <= 1e3 * gap_s + 1e-6


@pytest.mark.full
def test_a_wrong_board_view_is_dropped():
    truth = above(3)
    views = board_session(truth)
    bad = views["cam1"][4]
    views["cam1"][4] = replace(bad, view=replace(bad.view, xy=bad.view.xy + [60.0, -30.0]))
    known = {n: from_vector(*SIZE, VECTOR) for n in truth}
    found = rig_from_board(views, SPEC, known, known)
    assert ("cam1", 4) in found.dropped
    ours, true = found.cameras["cam2"], relative(truth, "cam2")
    assert rotation_angle_deg(ours.cam_from_world[:, :3], true.cam_from_world[:, :3]) < 0.1


def test_cameras_without_a_common_board_are_named():
    truth = above(2)
    views = board_session(truth)
    views["cam1"] = [TimedView(v.view, v.time_s + 100.0) for v in views["cam1"]]
    known = {n: from_vector(*SIZE, VECTOR) for n in truth}
    with refused("rig-unlinked-camera", "cam1", "cam0", "0 corners", kind=HealthError):
        rig_from_board(views, SPEC, known, known)


@pytest.mark.parametrize("lost", ["cam0", "cam2"])
def test_a_camera_that_the_board_does_not_tie_is_left_out_where_others_are_enough(lost):
    truth = above(3)
    views = board_session(truth)
    views[lost] = [TimedView(v.view, v.time_s + 100.0) for v in views[lost]]
    known = {n: from_vector(*SIZE, VECTOR) for n in truth}
    found = rig_from_board(views, SPEC, known, known)
    rest = [name for name in truth if name != lost]
    assert list(found.left_out) == [lost] and all(name in found.left_out[lost] for name in rest)
    assert list(found.cameras) == rest
    one, other = (c[rest[1]].moved(np.linalg.inv(c[rest[0]].world_from_cam)) for c in (truth, found.cameras))
    assert np.linalg.norm(one.centre - other.centre) < 0.02 * np.linalg.norm(one.centre)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_a_camera_that_was_moved_since_it_was_given_is_told_by_the_others(count):
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = 2.5 * cv2.Rodrigues(np.array([0.2, 0.5, -0.3]))[0], [3.0, -1.0, 0.4]
    given = {f"cam{n}": camera for n, camera in enumerate(ring(count, radius=2.6, height=0.8))}
    world = {n: camera.moved(turned) for n, camera in given.items()}
    shifted = np.eye(4)
    shifted[:3, 3] = [1.0, 0.7, 0.4]
    world["cam1"] = world["cam1"].moved(shifted)
    stood = rig_in_world(given, world, most=0.1)
    if count == 3:  # nobody knows which
        assert len(stood.fitted) == 3 and max(stood.off.values()) > 0.1
        return
    assert set(stood.fitted) == given.keys() - {"cam1"} and stood.off["cam1"] > 1
    np.testing.assert_allclose(stood.world_from_rig, turned, atol=1e-9)


@pytest.mark.full
def test_sweep_and_board_adjusted_together(sweep, tmp_path, monkeypatch):
    """A metre is 1.25 units of the sweep; the board route knows only metres, the sweep's only its unit."""
    model, look = sweep
    truth = above(3)
    features = {f"{n}_clip": features_of(c, model, look, 20 + i) for i, (n, c) in enumerate(truth.items())}
    monkeypatch.setattr(sweep_route, "_features", lambda *_: features)
    std = np.array([3.0, 3.0, 1.0, 1.0, 5e-3, 0, 0, 0, 0])
    rng = np.random.default_rng(2)
    known = {n: from_vector(*SIZE, VECTOR + std * rng.standard_normal(9), std) for n in truth}
    inputs = [FixedCameraInput(n, [tmp_path / f"{n}_clip.png"], *SIZE, k) for n, k in known.items()]
    swept = rig_from_sweep(model, inputs, tmp_path)
    ours = {n: c.camera for n, c in swept.cameras.items()}
    metric = {n: c.moved(np.diag([0.8, 0.8, 0.8, 1.0])) for n, c in truth.items()}
    board = rig_from_board(board_session(metric), SPEC, known, known)
    both = adjust_together(swept.solution, swept.index, ours, board)
    assert abs(both.problem.unit * 0.8 - 1) < 4 * both.unit_std
    assert both.unit_std < 2e-3
    for name, c in swept.index.items():
        found = camera_of(both.problem, guess(*SIZE), c)
        turn, position = errors(found, truth[name])
        std = np.sqrt(np.diag(both.pose_covariance[c]))
        # of three turns and three shifts, 5 standard deviations of their root sum of squares
        assert turn < 5 * np.degrees(np.linalg.norm(std[:3]))
        assert position * np.linalg.norm(truth[name].centre) < 5 * np.linalg.norm(std[3:])
    graph = camera_graph(both.problem, swept.index)
    assert len(graph) == 3 and all(link.corners > 200 and link.points > 50 for link in graph)

    # the stage says the same, and that both routes agree
    job = object.__new__(RigJob)
    job.measures, job.scales = [], []
    seen = JointViews(SPEC, {}, known, known, {})
    monkeypatch.setattr(RigJob, "board_is_measured", property(lambda self: True))
    monkeypatch.setattr(RigJob, "board_rig", lambda self, names, progress: (seen, board))
    together = rig_routes._together(job, swept, swept.cameras, list(truth), lambda fraction, message: None)
    assert together is not None and together[1] == graph
    assert [row.verdict for row in judge(job.measures)] == ["ok"] * 6
    assert job.scales[0].factor == pytest.approx(0.8, rel=4 * both.unit_std)
    whole = Rig(
        {n: rig_routes._scaled(c, 0.8) for n, c in together[0].items()}, job.scales[0], "sweep", graph
    )
    write_rig(tmp_path / "rig.json", whole)
    content = json.loads((tmp_path / "rig.json").read_text())
    assert content["graph"][0].keys() == {"a", "b", "corners", "points"}
    details = content["cameras"]["cam1"]["details"]
    variance = np.trace(details["position_covariance"])
    assert np.sqrt(variance) == pytest.approx(content["cameras"]["cam1"]["std"]["position"])
    assert 0 < len(details["residuals"]) <= 500 and "delay_ms" in details


def test_worlds_that_differ_by_a_similarity_agree():
    cameras = fixed_cameras()
    turn = np.eye(4)
    turn[:3, :3] = 2.5 * cv2.Rodrigues(np.array([0.3, -0.7, 0.2]))[0]
    turn[:3, 3] = [1.0, -2.0, 0.5]
    other = {n: c.moved(turn) for n, c in cameras.items()}
    for angle, shift in disagreement(other, cameras).values():
        assert angle < 1e-6 and shift < 1e-9
    names = list(cameras)[:2]  # two are enough: their own turns count
    two = disagreement(other, {n: cameras[n] for n in names})
    assert list(two) == names and max(shift for _, shift in two.values()) < 1e-9


def test_scales_that_agree_are_combined_and_a_mistake_is_left_out():
    board, tape = Scale(True, "board", 2.0, 1e-3), Scale(True, "tape", 2.01, 1e-3)
    both = combined([board, tape])
    assert both.factor == pytest.approx(2.005) and both.std == pytest.approx(1e-3 / np.sqrt(2))
    assert both.source == "board; tape"
    assert combined([board, Scale(True, "tape", 2.2, None)]) == board


def test_scale_from_a_board_in_the_sweep():
    factor = 0.37
    cameras = [c.moved(np.diag([1 / factor] * 3 + [1.0])) for c in ring(14)]  # the sweep's unit is 0.37 m
    rng = np.random.default_rng(0)
    corners = SPEC.corners + [0.1, -0.2, 0.05]
    views = []
    for n, camera in enumerate(cameras[:6]):
        xy = camera.project(corners / factor) + 0.1 * rng.standard_normal((len(corners), 2))
        views.append(BoardView(n, np.arange(len(corners)), xy))
    scale, text = scale_from_board(views, cameras, SPEC)
    assert scale is not None and scale.metric and scale.std is not None
    assert scale.std < 2e-3
    assert abs(scale.factor / factor - 1) < 4 * scale.std
    assert "24 corners" in text
    moved = [replace(v, xy=v.xy + 15.0 * v.frame) for v in views]
    assert scale_from_board(moved, cameras, SPEC)[0] is None
    assert scale_from_board(views[:2], cameras, SPEC)[0] is None


def test_scale_from_known_distances():
    true = {"a": np.zeros(3), "b": np.array([2.0, 0, 0]), "c": np.array([0, 3.0, 0])}
    sweep = {name: x / 4 + 1 for name, x in true.items()}
    scale = scale_from_distances(true, sweep, "tape")
    assert scale is not None and scale.factor == pytest.approx(4.0)
    assert scale_from_distances({"a": np.zeros(3)}, sweep, "tape") is None


def test_rig_json_there_and_back(tmp_path):
    camera = fixed_cameras()["cam0"]
    rig = Rig({"cam0": RigCamera(camera, "board", 0.01, 0.002, 120, 0.4)}, Scale(True, "board", 0.4, 0.001))
    write_rig(tmp_path / "rig.json", rig)
    back = read_rig(tmp_path / "rig.json")
    np.testing.assert_array_equal(back.cameras["cam0"].camera.cam_from_world, camera.cam_from_world)
    assert back.scale == rig.scale and back.cameras["cam0"].inliers == 120
    content = json.loads((tmp_path / "rig.json").read_text())
    assert content["cameras"]["cam0"]["std"] == {"rotation_deg": 0.01, "position": 0.002}


def test_intrinsics_count_pixels_from_the_corner():
    k = Intrinsics(*SIZE, from_vector(*SIZE, VECTOR).K, VECTOR[4:])
    np.testing.assert_allclose(k.vector, VECTOR)
    np.testing.assert_allclose(k.cv_matrix[:2, 2], VECTOR[2:4] - 0.5)
