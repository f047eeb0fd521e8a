"""`devrf.load`: a finished run as arrays, against models whose answers are known in closed form."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.make.models import RADIUS, TRAVEL, moving_ball, moving_parts
from tests.pipelines.trained_run import SCALE, write_trained

import devrf

VOXEL = 2.0 / 24 / SCALE  # world units
R, MOVED = RADIUS / SCALE, np.array([TRAVEL / SCALE, 0, 0])  # of the ball; how far it goes from 0 s to 1 s


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> devrf.Reconstruction:
    folder = tmp_path_factory.mktemp("ball")
    write_trained(folder, model=moving_ball(resolution=24))
    return devrf.load(folder / "run", device="cpu")


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> devrf.Reconstruction:
    folder = tmp_path_factory.mktemp("parts")
    write_trained(folder, model=moving_parts(resolution=24))
    return devrf.load(folder / "run", device="cpu")


def raised(code: str, call: object, *arguments: object) -> str:
    with pytest.raises(devrf.DevrfError) as error:
        call(*arguments)  # type: ignore[operator]
    assert error.value.code == code
    return str(error.value)


def test_cameras_have_names_and_the_size_of_training(ball: devrf.Reconstruction) -> None:
    assert list(ball.cameras) == ["cam0", "cam1", "cam2", *(f"static/{n}" for n in range(8))]
    assert ball.metric
    frame = next(f for f in ball.scene.dynamic if f.camera_name == "cam1")
    small = replace(ball, scene=replace(ball.scene, image_scale=0.5))
    assert small.cameras["cam1"].width == frame.camera.width / 2


@pytest.mark.parametrize("time_s", [None, 0.25, 1.0])
def test_a_view_shows_the_ball_where_it_is(ball: devrf.Reconstruction, time_s: float | None) -> None:
    camera = ball.cameras["cam1"].scaled(0.25)
    middle = (time_s or 0.0) * MOVED
    view = ball.render(camera, time_s)
    size = (camera.height, camera.width)
    assert view.colour.shape == (*size, 3) and view.depth.shape == view.opacity.shape == size
    away = middle - camera.centre
    nearest = middle - R * away / np.linalg.norm(away)
    column, row = camera.project(middle).astype(int)
    depth = camera.cam_from_world[2] @ [*nearest, 1.0]
    assert abs(view.depth[row, column] - depth) < VOXEL
    assert view.opacity[row, column] > 0.99 and view.opacity[0, 0] == view.depth[0, 0] == 0
    assert view.colour[row, column] == pytest.approx((0.8, 0.4, 0.2), abs=0.02)
    assert view.colour[0, 0] == pytest.approx(1.0)


def test_the_surface_and_where_it_goes(ball: devrf.Reconstruction) -> None:
    np.testing.assert_allclose(ball.times_s, [0.0, 0.5, 1.0])
    small = replace(ball, scene=replace(ball.scene, image_scale=0.3))  # it is rendered from every pose
    cloud = small.points(0.5)
    radial = cloud.xyz - MOVED / 2
    away = np.linalg.norm(radial, axis=1)
    assert (
        len(cloud.xyz) > 300 and (np.abs(away - R) < VOXEL).all() and np.abs(np.median(away) - R) < VOXEL / 2
    )
    assert np.median((cloud.normals * radial / away[:, None]).sum(1)) > 0.95
    ways = ball.tracks(cloud.xyz, 0.5)
    expected = cloud.xyz + np.array([-0.5, 0, 0.5])[:, None, None] * MOVED
    np.testing.assert_allclose(ways, expected, atol=VOXEL / 20)  # files are true to a fortieth of a voxel


def test_parts_and_tracks_are_the_same_motion(parts: devrf.Reconstruction) -> None:
    stick, ball = parts.parts
    assert (stick.number, ball.number) == (1, 2) and stick.rigid and ball.rigid
    assert len(stick.poses) == len(parts.times_s) == 9
    at_rest = np.array([[-0.4, 0.1, 0.4], [0.4, 0.0, -0.25], [0.4, 0.05, -0.6]]) / SCALE  # stick, ball, slab
    ways = parts.tracks(at_rest)
    for n, part in enumerate((stick, ball)):
        np.testing.assert_allclose(
            ways[:, n], part.poses[:, :3, :3] @ at_rest[n] + part.poses[:, :3, 3], atol=1e-5
        )
    np.testing.assert_allclose(ways[:, 2], np.tile(at_rest[2], (9, 1)), atol=1e-6)
    assert np.linalg.norm(ways[-1, 1] - ways[0, 1]) == pytest.approx(0.6 / SCALE, abs=1e-5)
    np.testing.assert_allclose(np.linalg.det(stick.poses), 1.0, atol=1e-5)


def test_every_moment_can_be_asked_for_though_some_lie_outside_the_common_time(
    parts: devrf.Reconstruction,
) -> None:
    movers = parts.model.movers
    assert movers is not None
    wider = replace(movers, times=torch.linspace(-0.02, 1.03, len(movers.times)))
    scene = replace(parts, model=replace(parts.model, movers=wider))
    at_rest = np.array([[0.4, 0.0, -0.25]]) / SCALE  # on the ball
    ways = scene.tracks(at_rest)
    for n in (0, -1):
        time_s = float(scene.times_s[n])
        assert scene.render("cam0", time_s).opacity.max() > 0.99
        np.testing.assert_allclose(scene.tracks(ways[n], time_s)[n], ways[n], atol=VOXEL)
    raised("option-out-of-range", scene.render, "cam0", 1.04 * scene.times_s[-1])


def test_a_camera_between_two(ball: devrf.Reconstruction) -> None:
    a, b = ball.cameras["cam0"], ball.cameras["cam1"]
    half = ball.between("cam0", "cam1")
    np.testing.assert_allclose(half.centre, (a.centre + b.centre) / 2, atol=1e-9)
    np.testing.assert_allclose(ball.between("cam0", "cam1", 1.0).cam_from_world, b.cam_from_world, atol=1e-9)
    raised("camera-unknown", ball.between, "cam0", "cam9")


def test_what_is_refused(ball: devrf.Reconstruction, tmp_path: Path) -> None:
    assert "cam0, cam1" in raised("camera-unknown", ball.render, "cam9", 0.0)
    for time_s in (-0.1, 1.1, float("nan")):
        assert "0.000 to 1.000" in raised("option-out-of-range", ball.render, "cam0", time_s)
    raised("option-out-of-range", ball.points, 2.0)
    raised("folder-missing", devrf.load, tmp_path / "nowhere")
    raised("stage-not-made", devrf.load, tmp_path)
    raised("option-unknown-value", lambda: devrf.load(ball.run_folder, device="tpu"))
    with pytest.raises(devrf.DevrfError) as error:
        _ = ball.metrics
    assert error.value.code == "stage-not-made" and "evaluate" in str(error.value)


def test_numbers_of_a_finished_run(ball: devrf.Reconstruction, tmp_path: Path) -> None:
    shutil.copytree(ball.run_folder, tmp_path / "run")
    (tmp_path / "run" / "evaluate").mkdir()
    (tmp_path / "run" / "evaluate" / "stamp.json").write_text("{}")
    (tmp_path / "run" / "evaluate" / "metrics.json").write_text(json.dumps({"test": {"psnr": 30.5}}))
    assert devrf.load(str(tmp_path / "run"), device="cpu").metrics["test"]["psnr"] == 30.5


def test_without_motion(tmp_path: Path, ball: devrf.Reconstruction) -> None:
    write_trained(tmp_path / "still", moves=False, model=moving_ball(resolution=24))
    still = devrf.load(tmp_path / "still" / "run", device="cpu")
    assert not len(still.times_s) and still.parts == ()
    assert still.tracks(np.zeros((2, 3))).shape == (0, 2, 3)
    raised("scene-without-motion", still.render, "static/0", 0.5)
    shutil.copytree(ball.run_folder, tmp_path / "unfinished")
    shutil.rmtree(tmp_path / "unfinished" / "deformation")
    unfinished = devrf.load(tmp_path / "unfinished", device="cpu")
    raised("stage-not-made", unfinished.render, "cam0", 0.5)
    assert unfinished.render(unfinished.cameras["cam0"].scaled(0.1)).opacity.max() > 0.9
