"""Masks of moving pixels and of silhouettes, against words and against OpenCV where it is installed."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.reconstruct.conftest import held_rays

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import write_png
from devrf.capture.scene import PosedFrame
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.hull import silhouette
from devrf.reconstruct.evaluation.error_map import error_map
from devrf.reconstruct.sampling.moving_pixels import changing_pixels

WIDTH, HEIGHT = 140, 90
CAMERA = Camera(WIDTH, HEIGHT, np.array([[100.0, 0, 70], [0, 100, 45], [0, 0, 1]]), np.eye(4)[:3])


def film(noise: float = 2.0) -> list[np.ndarray]:
    """Five noisy pictures over which a square passes; one pixel of one picture is wrong."""
    rng = np.random.default_rng(0)
    ground = rng.integers(60, 120, (HEIGHT, WIDTH, 3))
    out = []
    for n in range(5):
        picture = ground + rng.normal(0, noise, ground.shape)
        picture[30:45, 20 + 15 * n : 30 + 15 * n] = 240
        out.append(picture.clip(0, 255).astype(np.uint8))
    out[2][80, 120] = 255
    return out


def mask_of(pictures: list[np.ndarray]) -> np.ndarray:
    found = changing_pixels(held_rays([CAMERA] * len(pictures), pictures)).of_frame
    mask = np.zeros(WIDTH * HEIGHT, bool)
    mask[found[0].numpy()] = True
    return mask.reshape(HEIGHT, WIDTH)


def test_what_passes_is_found_and_what_stands_is_not() -> None:
    mask = mask_of(film())
    assert mask[30:45, 20:90].all()
    assert not mask[:20].any() and not mask[60:75].any() and not mask[:, 110:118].any()


def test_what_moves_over_its_own_colour_is_found_by_flow() -> None:
    """Cloth before cloth of its colour: nothing changes by 4 %, but flow knows."""
    rng = np.random.default_rng(1)
    pictures = [rng.integers(100, 104, (HEIGHT, WIDTH, 3)).astype(np.uint8) for _ in range(3)]
    frames = tuple(PosedFrame(Path(f"{n}.png"), CAMERA, "cam0", n, None, n / 2, "train") for n in range(3))
    rays = held_rays([CAMERA] * 3, pictures)
    rays.frames = frames
    flow = np.zeros((2, HEIGHT, WIDTH, 2), np.float16)
    flow[0, 30:50, 40:70, 0] = 3.0
    flow[1, 10:20, 10:20, 1] = 3.0
    flow[1, 70, 100, 1] = 9.0  # a single pixel is an error
    confidence = np.full(flow.shape[:3], 15, np.uint8)
    confidence[1, :25] = 5  # not sure
    clip = CameraFlow("cam0", np.array([1, 2], np.int32), flow, confidence > 0, confidence)
    assert not len(changing_pixels(rays).of_frame[0])
    mask = np.zeros(WIDTH * HEIGHT, bool)
    mask[changing_pixels(rays, {"cam0": clip}).of_frame[0].numpy()] = True
    mask = mask.reshape(HEIGHT, WIDTH)
    assert mask[30:50, 40:70].all() and mask.sum() < 27 * 37  # 1.5 % of the width around
    assert not mask[:25].any() and not mask[60:].any()


def test_pictures_without_change_are_on_the_device_of_the_others() -> None:
    """A second camera has one picture: of its pixels none is known to change."""
    pictures = film()
    other = CAMERA.moved(np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    rays = held_rays([CAMERA] * len(pictures) + [other], [*pictures, pictures[0]])
    rays.device = torch.device("meta")
    found = changing_pixels(rays)
    assert len(found.of_frame[0]) and {pixels.device.type for pixels in found.of_frame} == {"meta"}


def test_changing_pixels_are_those_of_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    pictures = film()
    smooth = np.stack([cv2.GaussianBlur(p, (0, 0), 1.0) for p in pictures]).astype(np.float32) / 255
    apart = np.abs(smooth - np.median(smooth, axis=0)).max(axis=(0, 3))
    changed = (apart > max(0.04, 5 * np.median(apart))).astype(np.uint8)
    changed = cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    theirs = cv2.dilate(changed, np.ones((5, 5), np.uint8)) > 0  # 1.5 % of the width on either side
    # the blurred pictures differ by a level here and there, which moves a few pixels over the limit
    assert (mask_of(pictures) != theirs).mean() < 2e-3


@pytest.mark.parametrize(("background", "plain"), [("white", 255), ("black", 0)])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_silhouette(tmp_path, background, plain, channels) -> None:
    subject = np.zeros((HEIGHT, WIDTH), bool)
    subject[20:50, 30:90] = True
    picture = np.full((HEIGHT, WIDTH, 3), plain, np.uint8)
    picture[subject] = 128
    if channels == 4:
        picture = np.dstack([picture, np.where(subject, 6, 5).astype(np.uint8)])  # above and below 2 %
    if channels == 1:
        Image.fromarray(picture[..., 0]).save(tmp_path / "a.png")
    else:
        write_png(tmp_path / "a.png", picture)
    frame = PosedFrame(tmp_path / "a.png", CAMERA, "static", 0, None, None, "train")
    np.testing.assert_array_equal(silhouette(frame, background), subject)


def test_error_map_is_opencvs_inferno() -> None:
    cv2 = pytest.importorskip("cv2")
    levels = np.arange(256, dtype=np.uint8)[None]
    theirs = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1] / 255
    true = np.zeros((1, 256, 3), np.float32)
    ours = error_map(np.repeat(levels[..., None] / 255, 3, axis=2).astype(np.float32) / 4, true)
    np.testing.assert_allclose(ours, theirs, atol=6 / 255)  # between every 15th colour
