"""Plates of fixed cameras: what stands, without pixels over which anything moved."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling import clean_plate as still_picture
from devrf.reconstruct.sampling.clean_plate import plate
from devrf.reconstruct.sampling.plates import SHARE, draw_with_plates, plates

SIZE = 64, 48  # width, height
CAMERA = Camera(*SIZE, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(3, 4))


def _pictures(count: int, noise: float = 1.5) -> np.ndarray:
    """A bright square crosses a room in `count` pictures."""
    rng = np.random.default_rng(0)
    room = rng.integers(60, 180, (*SIZE[::-1], 3)).astype(np.float32)
    pictures = room + noise * rng.standard_normal((count, *room.shape))
    for n in range(count):
        x = 8 + round(30 * n / (count - 1))
        pictures[n, 16:28, x : x + 10] = 240
    return pictures.clip(0, 255).round().astype(np.uint8)


def _scene(folder: Path, **changes: object) -> Scene:
    frames = []
    for n, picture in enumerate(_pictures(21)):
        path = folder / f"{n}.png"
        cv2.imwrite(str(path), picture[..., ::-1])
        frames.append(PosedFrame(path, CAMERA, "cam0", n, n / 10, n / 20, "train"))
    still = replace(frames[0], camera_name="static", time=None, time_s=None)
    scene = scene_of((still,), frames, far=9.0, t1_s=2.0)
    return replace(scene, **changes)


def test_a_plate_leaves_out_where_anything_moved_and_nothing_else(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    picture, kept = plate(scene, scene.dynamic)
    assert not kept[14:30, 8:48].any()  # the square's way
    assert kept[:8].all() and kept[36:].all() and kept.mean() > 0.5
    truth = _pictures(21, noise=0.0)[-1]
    assert np.abs(picture.astype(int) - truth)[kept].max() <= 2


def test_plates_are_drawn_beside_the_sweep(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    rays, shares = plates(scene, "cpu")
    assert rays is not None and len(rays) == 1 and 0.5 < shares["cam0"] < 0.9
    sweep = RaySet(scene.static, 1.0, "shell")
    batch = draw_with_plates(sweep, rays, 1000, torch.Generator().manual_seed(0))
    assert len(batch.rgb) == 1000
    row = batch.pixel[-round(1000 * SHARE) :] // SIZE[0]
    column = batch.pixel[-round(1000 * SHARE) :] % SIZE[0]
    assert not ((row >= 16) & (row < 28) & (column >= 8) & (column < 48)).any()
    alone = draw_with_plates(sweep, None, 1000, torch.Generator().manual_seed(0))
    assert torch.equal(alone.pixel, sweep.draw(1000, torch.Generator().manual_seed(0)).pixel)


def test_a_camera_that_is_never_at_rest_teaches_nothing(tmp_path: Path) -> None:
    """Every picture of it shows something else; beside a good camera all rays are that one's."""
    good = _scene(tmp_path)
    rng = np.random.default_rng(1)
    restless = []
    for n, frame in enumerate(good.dynamic):
        path = tmp_path / f"restless{n}.png"
        cv2.imwrite(str(path), rng.integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8))
        restless.append(replace(frame, path=path, camera_name="cam1"))
    rays, shares = plates(replace(good, dynamic=(*restless, *good.dynamic)), "cpu")
    assert rays is not None and shares["cam1"] == 0 and shares["cam0"] > 0.5
    drawn = rays.draw(2000, torch.Generator().manual_seed(0))
    assert {rays.frames[n].camera_name for n in drawn.frame.tolist()} == {"cam0"}
    assert plates(replace(good, dynamic=tuple(restless)), "cpu") == (None, {"cam1": 0.0})


def test_test_cameras_and_those_that_move_have_none(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    for changed in (
        replace(scene, dynamic=tuple(replace(f, split="test") for f in scene.dynamic)),
        replace(scene, background="white"),
        replace(scene, dynamic=scene.dynamic[:4]),
        replace(
            scene,
            dynamic=tuple(
                replace(f, camera=replace(CAMERA, cam_from_world=np.eye(3, 4) + 0.01 * n * np.eye(3, 4, 3)))
                for n, f in enumerate(scene.dynamic)
            ),
        ),
    ):
        assert plates(changed, "cpu") == (None, {})


def test_few_pictures_are_held_where_they_are_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = _scene(tmp_path)
    read = list[str]()
    load = still_picture.load_image
    monkeypatch.setattr(still_picture, "load_image", lambda f, *a: (read.append(f.path.name), load(f, *a))[1])
    monkeypatch.setattr(still_picture, "MOST_BYTES", 8 * 3 * SIZE[0] * SIZE[1])
    plate(scene, scene.dynamic)
    assert len(read) == 8
