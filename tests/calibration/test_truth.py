"""Comparison with the truth: errors put in come out, and the free choice of frame and scale does not."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.refused import refused

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.truth import (
    Truth,
    compare_cameras,
    compare_clocks,
    read_masks,
    read_truth,
    rotation_angle_deg,
    similarity,
)
from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError

K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])


def random_poses(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    poses = []
    for turn in Rotation.random(count, rng=rng).as_matrix():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, 2 * rng.normal(size=3)
        poses.append(pose)
    return poses


def camera_at(world_from_cam: np.ndarray) -> Camera:
    return Camera(64, 48, K, np.linalg.inv(world_from_cam)[:3])


def random_similarity(seed: int = 5) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = 0.3 * Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    out[:3, 3] = [4, -5, 6]
    return out


@pytest.fixture
def session():
    """Twelve sweep poses, four fixed ones, and the same cameras in a frame and scale of their own."""
    sweep, fixed = random_poses(12), random_poses(4, seed=1)
    for pose in fixed:  # two metres from the origin, which is the scene's centre
        pose[:3, 3] *= 2 / np.linalg.norm(pose[:3, 3])
    truth = Truth(dict(enumerate(sweep)), {f"cam{i}": p for i, p in enumerate(fixed)}, {})
    move = random_similarity()
    static = {n: camera_at(p).moved(move) for n, p in truth.static.items()}
    cameras = {n: camera_at(p).moved(move) for n, p in truth.cameras.items()}
    return truth, static, cameras, move


def test_frame_and_scale_are_free(session):
    truth, static, cameras, move = session
    out = compare_cameras(truth, static, cameras, move[:3, 3])
    assert out["scale"] == pytest.approx(1 / 0.3)
    assert out["pose_rotation_deg"] == pytest.approx(0, abs=1e-6)
    assert out["rig_position_m"] == pytest.approx(0, abs=1e-9)


def test_errors_put_in_come_out(session):
    truth, static, cameras, move = session
    spoiled = truth.cameras["cam2"].copy()
    spoiled[:3, :3] = spoiled[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(0.25)]).as_matrix()
    cameras["cam2"] = camera_at(spoiled).moved(move)
    out = compare_cameras(truth, static, cameras, move[:3, 3])
    assert out["rig_rotation_deg"] == pytest.approx(0.25, abs=1e-6)
    assert out["rig_rotation_deg_median"] == pytest.approx(0, abs=1e-6)
    assert out["pose_rotation_deg"] == pytest.approx(0, abs=1e-6)

    spoiled = truth.cameras["cam2"].copy()
    spoiled[:3, 3] += [0.01, 0, 0]
    cameras["cam2"] = camera_at(spoiled).moved(move)
    out = {k: v or 0.0 for k, v in compare_cameras(truth, static, cameras, move[:3, 3]).items()}
    # one of 16 centres is wrong: the fit takes a part of it, by how far out the camera stands
    assert 0.005 < out["rig_position_m"] < 0.01
    assert out["rig_position_percent"] == pytest.approx(100 * out["rig_position_m"] / 2, rel=1e-2)
    assert 0 < out["pose_position_m"] < 0.003


def test_sweep_frames_are_matched_by_index(session):
    truth, static, cameras, move = session
    some = {n: camera for n, camera in static.items() if n % 3 == 0}
    assert compare_cameras(truth, some, cameras, move[:3, 3])["pose_position_m"] == pytest.approx(0, abs=1e-9)
    shifted = {n: static[n - 1] for n in range(1, 12)}
    assert (compare_cameras(truth, shifted, cameras, move[:3, 3])["pose_position_m"] or 0) > 0.1


def test_too_few_cameras_give_no_number(session):
    truth, static, _, move = session
    out = compare_cameras(truth, {0: static[0], 1: static[1]}, {}, move[:3, 3])
    assert out["pose_rotation_deg"] is None and out["rig_position_percent"] is None


def test_similarity_without_reflection():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(20, 3))
    move = random_similarity()
    target = source @ move[:3, :3].T + move[:3, 3]
    np.testing.assert_allclose(similarity(source, target), move, atol=1e-12)
    target = source * [1, 1, -1]
    mirrored = similarity(source, target)
    scale = np.cbrt(np.linalg.det(mirrored[:3, :3]))
    s, t = source - source.mean(0), target - target.mean(0)
    best = ((s @ mirrored[:3, :3].T / scale) * t).sum() / (s * s).sum()  # least squares for that turn
    assert scale > 0 and scale == pytest.approx(best)


@pytest.mark.parametrize("angle", [1e-6, 0.1, 90.0, 179.0])
def test_rotation_angle(angle):
    a = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    b = a @ Rotation.from_rotvec(np.radians(angle) * np.array([0.6, 0, 0.8])).as_matrix()
    assert rotation_angle_deg(a, b) == pytest.approx(angle, rel=1e-5)


def test_clock_error_is_the_largest_over_the_shared_span():
    truth = Truth({}, {}, {"cam0": Clock(0.0, 0.0), "cam1": Clock(0.12, 50.0), "cam2": Clock(-0.3, -20.0)})
    found = {"cam0": Clock(0.0, 0.0), "cam1": Clock(0.1203, 50.0), "cam2": Clock(-0.3, 20.0)}
    spans = {"cam0": (0.0, 10.0), "cam1": (0.0, 10.0), "cam2": (0.0, 10.0)}
    errors = compare_clocks(truth, found, spans)
    assert errors["cam0"] == pytest.approx(0)
    assert errors["cam1"] == pytest.approx(0.3, abs=1e-3)
    # the span ends where cam2's clip does: file time 10 s, 40 ppm wrong
    assert errors["cam2"] == pytest.approx(0.4, rel=1e-3)


def test_true_clocks_may_count_from_elsewhere():
    truth = Truth({}, {}, {"cam0": Clock(5.0, 30.0), "cam1": Clock(5.25, 30.0)})
    found = {"cam0": Clock(0.0, 0.0), "cam1": Clock(0.25 / (1 + 30e-6), 0.0)}
    errors = compare_clocks(truth, found, {"cam0": (0.0, 3.0), "cam1": (0.0, 3.0)})
    assert max(errors.values()) == pytest.approx(0, abs=1e-9)


def test_clips_that_share_nothing():
    truth = Truth({}, {}, {"cam0": Clock(0.0, 0.0), "cam1": Clock(100.0, 0.0)})
    assert compare_clocks(truth, dict(truth.clocks), {"cam0": (0.0, 3.0), "cam1": (0.0, 3.0)}) == {}


def test_read_truth(tmp_path):
    path = tmp_path / "ground_truth.json"
    pose = random_poses(1)[0].tolist()
    path.write_text(
        json.dumps({"static": [pose], "cams": {"cam0": {"pose": pose, "offset_s": 0.5, "drift_ppm": 3}}})
    )
    truth = read_truth(path)
    np.testing.assert_allclose(truth.static[0], pose)
    assert truth.clocks["cam0"] == Clock(0.5, 3.0)


@pytest.mark.parametrize(
    "content",
    [
        [1],
        "text",
        {"static": [[1, 2]]},
        {"static": [np.zeros((4, 4)).tolist()]},
        {"static": [np.full((4, 4), 1e308).tolist()]},
        {"cams": {"cam0": {"pose": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]}}},
        {"cams": {"cam0": {"pose": np.eye(4).tolist(), "offset_s": float("inf")}}},
        {"cams": {"cam0": {"pose": np.eye(4).tolist(), "offset_s": 0, "drift_ppm": -1e6}}},
    ],
)
def test_what_is_no_truth_is_refused(tmp_path, content):
    path = tmp_path / "ground_truth.json"
    path.write_text(json.dumps(content))
    with refused("file-damaged", "ground_truth.json", kind=InputError):
        read_truth(path)


def test_masks_lie_beside_the_truth(tmp_path):
    mask = np.random.default_rng(0).random((5, 6, 8)) > 0.5
    np.savez_compressed(tmp_path / "witness_mask.npz", mask=mask)
    path = tmp_path / "ground_truth.json"
    # there is one camera
    np.testing.assert_array_equal(read_masks(path, {"heldout": (5, 6, 8)})["heldout"], mask)
    assert read_masks(path, {"a": (5, 6, 8), "b": (5, 6, 8)}) == {}
    np.savez_compressed(tmp_path / "b_mask.npz", mask=mask.astype(np.uint8))
    (found,) = read_masks(path, {"a": (5, 6, 8), "b": (4, 6, 8)}).items()
    assert found[0] == "b" and found[1].dtype == bool and (found[1] == mask).all()


@pytest.mark.parametrize("wanted", [(6, 6, 8), (5, 6, 9), (5, 12, 16)])
def test_masks_of_other_pictures_are_named(tmp_path, wanted):
    np.savez_compressed(tmp_path / "a_mask.npz", mask=np.zeros((5, 6, 8), bool))
    with refused("mask-size-wrong", tmp_path / "a_mask.npz", [5, 6, 8], "a's clip", wanted[0]):
        read_masks(tmp_path / "ground_truth.json", {"a": wanted})
