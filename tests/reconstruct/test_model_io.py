"""Models survive the disk, and what is not a model is refused by name."""

from pathlib import Path

import numpy as np
import pytest
import torch

from devrf.capture.camera import Camera
from devrf.capture.errors import ReconstructError
from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.model import DynamicModel, render_layers, render_view
from devrf.reconstruct.model_io import FILE, load_model, load_motion, load_rest, save_motion, save_rest
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.shell import Shell
from devrf.reconstruct.train_canonical import RestModel

AABB = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]])


def _camera() -> Camera:
    pose = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3.0]])
    return Camera(20, 16, np.array([[25, 0, 10], [0, 25, 8], [0, 0, 1.0]]), pose)


def _model(background: str = "shell") -> DynamicModel:
    g = torch.Generator().manual_seed(0)
    canonical = Canonical.new(
        AABB, 16, 16, channels=4, mlp_width=8, stepsize=0.5, alpha_init=1e-2, alpha_threshold=1e-4,
        weight_threshold=1e-4, device="cpu", seed=0,
    )  # fmt: skip
    canonical.density += 3 * torch.randn(canonical.density.shape, generator=g)
    canonical.features += torch.randn(canonical.features.shape, generator=g)
    canonical.rebuild_occupancy()
    canonical.net.requires_grad_(False)
    shell = None
    if background == "shell":
        shell = Shell.new(AABB, 12, 12, near=0.3, far=9.0, centres=torch.zeros(1, 3), device="cpu")
        shell.grid += torch.randn(shell.grid.shape, generator=g)
        shell.rebuild_occupancy()
    motion = MotionField.still(AABB, 3, 5, t_first=0.0, t_last=1.0, rest_key=0, device="cpu")
    motion.backward[1:] += 0.1 * torch.randn(motion.backward[1:].shape, generator=g)
    return DynamicModel(RestModel(canonical, shell, background, 0.3, 9.0, {}), motion)


@pytest.mark.parametrize("background", ["shell", "white", "black"])
def test_loaded_model_renders_the_same(background: str, tmp_path: Path) -> None:
    model = _model(background)
    for name in ("canonical", "deformation"):
        (tmp_path / name).mkdir()
    save_rest(tmp_path / "canonical" / FILE, model.rest)
    assert load_model(tmp_path).motion is None
    assert model.motion is not None
    save_motion(tmp_path / "deformation" / FILE, model.motion)
    again = load_model(tmp_path)
    for time in (None, 0.0, 0.3, 1.0):
        before, after = render_view(model, _camera(), time), render_view(again, _camera(), time)
        np.testing.assert_allclose(before, after, atol=0.02)  # half precision of random features
        assert np.abs(before - after).mean() < 2e-3


def test_first_key_is_the_scene_at_rest_and_motion_is_seen_between_keys() -> None:
    model = _model("white")
    rest, first, between = (render_view(model, _camera(), time) for time in (None, 0.0, 0.25))
    np.testing.assert_allclose(rest, first, atol=2e-3)
    assert np.abs(between - rest).mean() > 1e-3


def test_layers_are_colour_depth_and_opacity() -> None:
    picture, depth, opacity = render_layers(_model("white"), _camera(), None)
    assert picture.shape == (16, 20, 3) and depth.shape == opacity.shape == (16, 20)
    assert 0 <= opacity.min() and opacity.max() <= 1 and opacity.max() > 0.5
    seen = opacity > 0.9
    mean = depth[seen] / opacity[seen]
    assert ((mean > 2.0) & (mean < 4.8)).all()


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    model = _model()
    rest, motion = tmp_path / "rest.safetensors", tmp_path / "motion.safetensors"
    save_rest(rest, model.rest)
    assert model.motion is not None
    save_motion(motion, model.motion)
    for load, wrong in ((load_rest, motion), (load_motion, rest), (load_rest, tmp_path / "none.safetensors")):
        with pytest.raises(ReconstructError, match=wrong.name):
            load(wrong)
    rest.write_bytes(rest.read_bytes()[:1000])
    with pytest.raises(ReconstructError, match="rest.safetensors"):
        load_rest(rest)
