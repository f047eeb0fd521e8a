"""Looks: closed form, way back, clipping, and through files and exports."""

from dataclasses import replace

import numpy as np
import pytest
from tests.make.pictures import frame_of
from tests.make.scenes import scene_of
from tests.refused import refused

from devrf.capture.colour.correction import Look, as_matrix
from devrf.capture.colour.srgb import linear_from_srgb, srgb_from_linear
from devrf.capture.formats.datasets import write_dataset
from devrf.capture.formats.parts.files import read_json, write_json
from devrf.capture.formats.parts.transforms import read_transforms, write_transforms
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import PosedFrame, load_image
from devrf.capture.system.errors import CaptureError

MIXED = as_matrix(np.array([[0.9, 0.06, -0.02], [0.03, 0.8, 0.05], [0.0, -0.04, 1.1]]))


def picture(height: int = 40, width: int = 70) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def frame(path, look: Look | None) -> PosedFrame:
    return frame_of(path, 70, 40, look)


@pytest.mark.parametrize("matrix", [Look().matrix, as_matrix(np.diag([1.2, 1.0, 0.7])), MIXED])
def test_a_look_is_its_formula(matrix):
    rgb, gains = picture(70), (1.1, 0.9, 1.0)  # more rows than are corrected at once
    out = Look(matrix, gains).apply(rgb)
    linear = (linear_from_srgb(rgb / 255) * gains) @ np.array(matrix).T
    expected = 255 * srgb_from_linear(np.clip(linear, 0, 1))
    # half a level of rounding, and the way back goes in steps of at most 0.05 levels
    np.testing.assert_allclose(out, expected, atol=0.5 + 0.05)


def test_what_is_clipped_stays_at_its_clip_level():
    white = np.full((1, 1, 3), 255, np.uint8)
    assert (Look(gains=(2.0, 2.0, 2.0)).apply(white) == 255).all()
    half = Look(gains=(0.5, 0.5, 0.5)).apply(white)
    assert (half == round(255 * 0.735357)).all()  # the sRGB curve at 0.5


@pytest.mark.parametrize(
    "bad", [{"gains": (1.0, 0.0, 1.0)}, {"gains": (1.0, np.nan, 1.0)}, {"matrix": as_matrix(np.ones((3, 3)))}]
)
def test_a_look_that_loses_colours_is_refused(bad):
    with pytest.raises(ValueError, match="look"):
        Look(**bad)


def test_loading_applies_the_look_and_leaves_alpha_alone(tmp_path):
    rgba = np.concatenate([picture(), np.full((40, 70, 1), 128, np.uint8)], axis=2)
    write_png(tmp_path / "a.png", rgba)
    look = Look(gains=(0.5, 0.5, 0.5))
    loaded = load_image(frame(tmp_path / "a.png", look), 1.0, "black")
    expected = np.round(look.apply(rgba[..., :3]).astype(np.float32) * (np.float32(128) / 255))
    np.testing.assert_allclose(loaded, expected, atol=1)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), rgba)  # the file is as it was


def test_transforms_carry_looks(tmp_path):
    write_png(tmp_path / "a.png", picture())
    looks = (None, Look(MIXED), Look(gains=(1.0, 2.0, 0.5)))
    write_transforms(tmp_path / "t" / "transforms.json", tuple(frame(tmp_path / "a.png", k) for k in looks))
    assert tuple(f.look for f in read_transforms(tmp_path / "t" / "transforms.json")) == looks


def test_a_damaged_look_is_named(tmp_path):
    write_png(tmp_path / "a.png", picture())
    path = tmp_path / "transforms.json"
    write_transforms(path, (frame(tmp_path / "a.png", Look(MIXED)),))
    meta = read_json(path)
    meta["frames"][0]["colour_matrix"] = [[1, 0], [0, 1]]
    write_json(path, meta)
    with refused("entry-wrong", "frames[0]", "colour_matrix", kind=CaptureError):
        read_transforms(path)


@pytest.mark.parametrize("dataset_format", ["nerfstudio", "colmap"])
def test_exports_hold_corrected_pictures(tmp_path, dataset_format):
    write_png(tmp_path / "a.png", picture())
    look = Look(MIXED)
    still = frame(tmp_path / "a.png", look)
    second = replace(still, index=1, look=None)
    scene = scene_of((still, second), far=2.0, rest_time=None)
    write_dataset(dataset_format, scene, tmp_path / "out")
    files = sorted(p for p in (tmp_path / "out").rglob("*.png") if "images_" not in str(p.parent))
    assert len(files) == 2
    np.testing.assert_array_equal(read_pixels(files[0])[..., :3], look.apply(picture()))
    np.testing.assert_array_equal(read_pixels(files[1])[..., :3], picture())
