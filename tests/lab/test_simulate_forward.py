"""A tiny forward-facing data set: poses in LLFF's conventions, mattes, truth of the wall and of the model."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.protocol.dataset_options import ForwardOptions
from devrf.lab.simulate.protocol.forward import llff_poses, normalised, simulate_forward
from devrf.lab.simulate.scenes.simulation import Simulation

SIZE = (64, 40)
TINY = ForwardOptions(static_views=4, times=3, spp=4)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("forward") / "flower"
    flower = Simulation("flower", 3, 1, SIZE, TINY)
    made = simulate_forward(out, flower)
    assert made.rendered == 4 + 4 + 4 * 3
    assert simulate_forward(out, flower).rendered == 0
    return out


def _picture(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def test_layout_is_the_published_one(dataset: Path) -> None:
    assert sorted(f.name for f in (dataset / "static/images").iterdir()) == [f"{i:03d}.png" for i in range(8)]
    moving = dataset / "dynamic_4views"
    for k in (1, 2, 3, 4):
        assert len(list((moving / f"view{k}" / "images").glob("???.png"))) == 3
        assert sorted(f.name for f in (moving / f"view{k}" / "images_flow").iterdir()) == [
            "001_bwd.npz",
            "002_bwd.npz",
        ]
        # The last of the sweep are the fixed cameras' pictures at rest: the same but for the noise of light.
        rest, first = (
            _picture(p).astype(float)
            for p in (dataset / f"static/images/{3 + k:03d}.png", moving / f"view{k}/images/000.png")
        )
        assert np.abs(rest - first).mean() < 12
    assert np.load(dataset / "static/poses_bounds.npy").shape == (8, 17)
    assert np.load(moving / "poses.npy").shape == (8, 3, 5) and np.load(moving / "bds.npy").shape == (8, 2)


def test_poses_are_in_llff_axes_and_bounds_are_depths(dataset: Path) -> None:
    rows = np.load(dataset / "static/poses_bounds.npy")
    poses, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    for pose in poses:
        R = pose[:, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        assert R[:, 0] @ [0, 0, -1] > 0.99 and R[:, 1] @ [1, 0, 0] > 0.99 and R[:, 2] @ [0, -1, 0] > 0.99
    np.testing.assert_allclose(poses[:, :2, 4], np.tile([40, 64], (8, 1)))
    assert np.ptp(poses[:, 0, 3]) > 0.5 and np.ptp(poses[:, 1, 3]) < 1e-9  # side by side on a plane
    assert (bounds[:, 0] > 3).all() and (bounds[:, 1] > bounds[:, 0] + 1).all() and (bounds[:, 1] < 8).all()
    for k in (1, 2, 3, 4):
        with np.load(dataset / f"dynamic_4views/view{k}/depth/000.npz") as stored:
            assert bounds[3 + k] == pytest.approx([stored["depth"].min(), stored["depth"].max()], rel=1e-6)


def test_moving_poses_are_normalised_as_the_published_loader_does(dataset: Path) -> None:
    rows = np.load(dataset / "static/poses_bounds.npy")
    poses, bounds = np.load(dataset / "dynamic_4views/poses.npy"), np.load(dataset / "dynamic_4views/bds.npy")
    assert bounds.min() == pytest.approx(1 / 0.75)
    scale = bounds[0, 0] / rows[0, 15]
    np.testing.assert_allclose(poses[:, :, 3].mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(poses[:, :, 2].mean(0)[:2], 0, atol=1e-12)  # the mean looks along -z
    centres = rows[:, :15].reshape(-1, 3, 5)[:, :, 3]
    between = np.linalg.norm(centres[:, None] - centres, axis=-1)
    after = np.linalg.norm(poses[:, None, :, 3] - poses[:, :, 3], axis=-1)
    np.testing.assert_allclose(after, scale * between, atol=1e-12)


def test_normalised_of_one_camera_is_the_identity() -> None:
    K = np.array([[50.0, 0, 32], [0, 50.0, 20], [0, 0, 1]])
    camera = Camera(64, 40, K, look_at(np.array([1.0, -4, 2]), np.array([0.3, 5, 1])))
    poses, bounds = normalised(llff_poses([camera]), np.array([[2.0, 8.0]]))
    np.testing.assert_allclose(poses[0, :, :4], np.eye(3, 4), atol=1e-12)  # right, up, back
    np.testing.assert_allclose(poses[0, :, 4], [40, 64, 50])
    np.testing.assert_allclose(bounds, [[1 / 0.75, 4 / 0.75]])


def test_alpha_is_the_model_s_matte_and_the_wall_stands_still(dataset: Path) -> None:
    for k in (1, 4):
        view = dataset / f"dynamic_4views/view{k}"
        picture = _picture(view / "images/002.png")
        with np.load(view / "depth/002.npz") as stored:
            depth = stored["depth"]
        with np.load(view / "images_flow/002_bwd.npz") as stored:
            flow, mask = stored["flow"], stored["mask"]
        wall = np.isclose(depth, depth.max(), atol=1e-4)
        assert (depth > 0).all() and picture[..., :3].min() >= 0
        matte = picture[..., 3]
        assert (matte[wall] < 200).all() and (matte[~wall] > 50).all()
        assert 0.03 < (matte == 255).mean() < 0.4
        assert picture[matte == 0][:, :3].mean() > 40  # the wall's colours are kept under alpha 0
        assert np.abs(flow[wall]).max() < 1e-3 and np.abs(flow[~wall]).max() > 1
        assert mask.mean() > 0.8
