"""Evaluation with models whose scores are known beforehand."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.evaluate import LpipsNets, evaluate

WIDTH, HEIGHT, SCALE = 100, 80, 0.5
TIMES = (0.0, 0.5, 1.0)
NO_LPIPS = LpipsNets.load(None)


def background() -> np.ndarray:
    """A smooth picture [HEIGHT, WIDTH, 3] whose reduction to half size is exact in 8 bits."""
    small = np.random.default_rng(0).integers(60, 160, (10, 10, 3)).astype(np.uint8)
    half = cv2.resize(small, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_CUBIC)
    return half.repeat(2, axis=0).repeat(2, axis=1)


def at(time: float | None) -> np.ndarray:
    """The scene: a bright square that moves right with time; at rest as at time 0."""
    picture = background()
    x = 10 + int(40 * (time or 0.0))
    picture[30:50, x : x + 20] = 250
    return picture


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A witness at three times, a training camera, and two sweep pictures of which one is held out."""
    K = np.array([[80.0, 0, 50], [0, 80, 40], [0, 0, 1]])
    camera = Camera(WIDTH, HEIGHT, K, np.eye(4)[:3])

    def frame(name: str, index: int, time: float | None, split) -> PosedFrame:
        path = tmp_path / f"{name}{index}.png"
        cv2.imwrite(str(path), at(time)[..., ::-1])
        return PosedFrame(path, camera, name, index, None if time is None else 2 * time, time, split)

    return Scene(
        static=(frame("static", 0, None, "test"), frame("static", 1, None, "train")),
        dynamic=tuple(
            frame(name, 3 * n, t, split)
            for name, split in (("witness", "test"), ("cam0", "train"))
            for n, t in enumerate(TIMES)
        ),
        box_from_world=np.diag([0.5, 0.5, 0.5, 1.0]),
        aabb=np.array([[-1.0, -1, -1], [1, 1, 1]]),
        near=0.1,
        far=4.0,
        kind="inward",
        background="shell",
        t0_s=0.0,
        t1_s=2.0,
        rest_time=0.0,
        image_scale=SCALE,
    )


def model(error: float, moves: bool = True) -> tuple[Callable, list]:
    """A model that is wrong by `error` everywhere, and the calls it got."""
    calls = []

    def render(camera: Camera, time: float | None) -> np.ndarray:
        calls.append((camera.width, camera.height, time))
        full = at(time if moves else None)
        return full[::2, ::2].astype(np.float32) / 255 + np.float32(error)

    return render, calls


def test_scores_of_a_known_error(scene, tmp_path):
    render, calls = model(0.01)
    out = evaluate(scene, render, NO_LPIPS, tmp_path)
    for block in (out["test"], out["test_static"], out["test_moving"]):
        assert block["psnr"] == pytest.approx(40, abs=1e-3)  # 8-bit rounding would give another value
        assert block["ssim"] > 0.99
        assert (
            block["lpips_vgg"] is None and "lpips_weights" in str(block["why"]) or block is out["test_moving"]
        )
    assert out["test"]["views"] == 3 and out["test_moving"]["views"] == 2 and out["test_static"]["views"] == 1
    assert {(w, h) for w, h, _ in calls} == {(50, 40)}
    # the witness stands: at rest it is rendered once, besides its three times and the held-out picture
    assert [t for *_, t in calls].count(None) == 2 and len(calls) == 5
    assert out["render_fps"] > 0


def test_baseline_is_the_scene_at_rest_on_the_same_pixels(scene, tmp_path):
    moving = evaluate(scene, model(0.01)[0], NO_LPIPS, tmp_path / "a")
    still = evaluate(scene, model(0.01, moves=False)[0], NO_LPIPS, tmp_path / "b")
    for part in ("test", "test_moving"):
        base = moving["static_baseline"][part]
        assert base["psnr"] == pytest.approx(still[part]["psnr"])  # a model that never moves is the baseline
        assert base["psnr"] == pytest.approx(still["static_baseline"][part]["psnr"])
        assert base["psnr"] < moving[part]["psnr"] - 10
    # what does not move is left out, so the baseline looks worse there than over the whole picture
    assert moving["static_baseline"]["test_moving"]["psnr"] < moving["static_baseline"]["test"]["psnr"] - 2


def test_moving_leaves_out_the_first_time_and_far_pixels(scene, tmp_path):
    def render(camera: Camera, time: float | None) -> np.ndarray:
        picture = at(time)[::2, ::2].astype(np.float32) / 255
        if time == 0.0:
            picture += np.float32(0.5)  # wrong at the first time only: must not count
        if time is not None:
            picture[:5] = 0  # wrong far from motion: must not count either
        return picture

    out = evaluate(scene, render, NO_LPIPS, tmp_path)
    assert out["test_moving"]["psnr"] == 100
    assert out["test"]["psnr"] < 40
    rows = [row for row in out["per_view"] if row["camera"] == "witness"]
    assert "moving" not in rows[0] and 0.1 < rows[1]["moving"]["share"] < 0.3


def test_pictures_are_written_and_named(scene, tmp_path):
    out = evaluate(scene, model(0.0)[0], NO_LPIPS, tmp_path)
    row = next(row for row in out["per_view"] if row["time"] == 0.5)
    assert row["true"] == "views/witness/000003_true.png"
    assert row["camera"] == "witness" and row["index"] == 3 and row["time_s"] == 1.0
    for kind in ("true", "rendered", "rest", "error"):
        assert (tmp_path / row[kind]).is_file()
    rendered, error = (np.asarray(Image.open(tmp_path / row[kind])) for kind in ("rendered", "error"))
    np.testing.assert_array_equal(rendered, at(0.5)[::2, ::2])
    assert error.max() <= 10


def test_scene_at_rest(scene, tmp_path):
    out = evaluate(replace(scene, dynamic=()), model(0.1)[0], NO_LPIPS, tmp_path)
    assert out["test"] == out["test_static"] and out["test"]["psnr"] == pytest.approx(20, abs=1e-3)
    assert out["test_moving"]["psnr"] is None
    assert out["test_moving"]["why"]["psnr"] == out["static_baseline"]["test"]["why"]["psnr"] != ""


def test_no_test_camera(scene, tmp_path):
    only_training = tuple(f for f in scene.dynamic if f.split == "train")
    out = evaluate(replace(scene, dynamic=only_training), model(0.1)[0], NO_LPIPS, tmp_path)
    assert out["test"]["psnr"] is None and "capture.test_cameras" in out["test"]["why"]["psnr"]
    assert out["test_static"]["psnr"] == pytest.approx(20, abs=1e-3)


def test_lpips_where_weights_are_given(scene, tmp_path, data_dir):
    name = "lpips_alex_v0.1.npz"
    (tmp_path / name).symlink_to(data_dir / "weights" / name)
    alex = LpipsNets.load(tmp_path)  # the other network's weights are not there
    full = replace(scene, image_scale=1.0, dynamic=scene.dynamic[:2])

    def render(camera: Camera, time: float | None) -> np.ndarray:
        return at(time).astype(np.float32) / 255

    out = evaluate(full, render, alex, tmp_path)
    assert out["test"]["lpips_alex"] == pytest.approx(0, abs=1e-6)
    assert out["static_baseline"]["test"]["lpips_alex"] > 0.001
    assert out["test"]["lpips_vgg"] is None and "lpips_vgg_v0.1.npz" in out["test"]["why"]["lpips_vgg"]
    assert out["test_moving"]["lpips_alex"] is None and out["test_moving"]["why"]["lpips_alex"]
    small = evaluate(scene, model(0.0)[0], alex, tmp_path / "small")
    assert "64 pixels" in small["test"]["why"]["lpips_alex"]
