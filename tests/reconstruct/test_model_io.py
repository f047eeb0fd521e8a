"""Models survive the disk, and what is not a model is refused by name."""

import errno
import os
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tests.make.models import before_random_model, random_model
from tests.refused import refused

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.rendering.model import DynamicModel, render_layers, render_view
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.storage.model_io import (
    FILE,
    TUNED_FILE,
    load_model,
    load_motion,
    load_rest,
    save_motion,
    save_rest,
)
from devrf.reconstruct.storage.training_log import TrainingLog


def test_a_disk_that_takes_no_such_file_is_the_systems_error(tmp_path: Path) -> None:
    """The library tells of it in words of its own."""
    code = (
        "import resource, sys, torch; from pathlib import Path\n"
        "from devrf.reconstruct.storage.tensor_file import save_tensors\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: save_tensors(Path(sys.argv[1]), {'a': torch.zeros(10_000)}, {})\n"
        "except OSError as error: sys.exit(error.errno)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.safetensors")], check=False)
    assert ended.returncode == errno.EFBIG


def test_files_have_the_rights_that_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        save_rest(tmp_path / "model", random_model().rest)
        checkpoint = Checkpoint(tmp_path / "state", "one", every_s=0.0)
        checkpoint.keep(1, 5, TrainingLog("cpu", 3), lambda: ({"a": torch.zeros(1)}, {}))
    finally:
        os.umask(before)
    assert [oct((tmp_path / name).stat().st_mode & 0o777) for name in ("model", "state")] == ["0o640"] * 2


@pytest.mark.parametrize(
    ("background", "deferred"), [("shell", False), ("white", False), ("black", False), ("white", True)]
)
def test_loaded_model_renders_the_same(background: str, deferred: bool, tmp_path: Path) -> None:
    model, points = random_model(background, deferred), torch.rand(99, 3).half().float()
    if model.rest.shell is not None:
        model.rest.shell.points = points
    for name in ("canonical", "deformation"):
        (tmp_path / name).mkdir()
    save_rest(tmp_path / "canonical" / FILE, model.rest)
    assert load_model(tmp_path).motion is None
    assert model.motion is not None
    save_motion(tmp_path / "deformation" / FILE, model.motion, model.rest.canonical.voxel)
    again = load_model(tmp_path)
    assert again.rest.canonical.deferred == deferred and again.in_motion is None
    if model.rest.shell is not None and again.rest.shell is not None:
        assert torch.equal(again.rest.shell.points, points)
    _render_the_same(model, again, atol=0.02)
    model.in_motion = replace(random_model(background, deferred, seed=1).rest, shell=None)
    save_rest(tmp_path / "deformation" / TUNED_FILE, model.in_motion)
    tuned = load_model(tmp_path)
    _render_the_same(model, tuned, atol=0.05)  # two random models
    at_rest, moving = (render_view(tuned, before_random_model(), time) for time in (None, 0.0))
    np.testing.assert_array_equal(at_rest, render_view(again, before_random_model(), None))
    assert np.abs(moving - at_rest).mean() > 1e-2


def _render_the_same(model: DynamicModel, again: DynamicModel, atol: float) -> None:
    for time in (None, 0.0, 0.3, 1.0):
        before, after = (
            render_view(model, before_random_model(), time),
            render_view(again, before_random_model(), time),
        )
        np.testing.assert_allclose(before, after, atol=atol)  # half precision of random features
        assert np.abs(before - after).mean() < 2e-3


def test_first_key_is_the_scene_at_rest_and_motion_is_seen_between_keys() -> None:
    model = random_model("white")
    rest, first, between = (render_view(model, before_random_model(), time) for time in (None, 0.0, 0.25))
    np.testing.assert_allclose(rest, first, atol=2e-3)
    assert np.abs(between - rest).mean() > 1e-3


def test_layers_are_colour_depth_and_opacity() -> None:
    picture, depth, opacity = render_layers(random_model("white"), before_random_model(), None)
    assert picture.shape == (16, 20, 3) and depth.shape == opacity.shape == (16, 20)
    assert 0 <= opacity.min() and opacity.max() <= 1 and opacity.max() > 0.5
    seen = opacity > 0.9
    mean = depth[seen] / opacity[seen]
    assert ((mean > 2.0) & (mean < 4.8)).all()


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    model = random_model()
    rest, motion = tmp_path / "rest.safetensors", tmp_path / "motion.safetensors"
    save_rest(rest, model.rest)
    assert model.motion is not None
    save_motion(motion, model.motion, 0.01)
    for load, wrong, expected in ((load_rest, motion, "rest"), (load_motion, rest, "motion")):
        with refused("model-wrong-kind", wrong, wrong.stem, expected, kind=ReconstructError):
            load(wrong)
    with refused("file-missing", tmp_path / "none.safetensors", kind=ReconstructError):
        load_rest(tmp_path / "none.safetensors")
    rest.write_bytes(rest.read_bytes()[:1000])
    with refused("file-damaged", rest, kind=ReconstructError):
        load_rest(rest)


def test_parts_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "rest.safetensors"
    save_rest(path, random_model().rest)
    with safe_open(str(path), framework="pt") as file:
        meta = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    for name in ("canonical.density", "canonical.occupied", "shell.codes"):
        save_file(tensors | {name: tensors[name][..., :-1].contiguous()}, str(path), metadata=meta)
        with refused("file-damaged", path, " fit ", kind=ReconstructError):
            load_rest(path)
    save_file({k: v for k, v in tensors.items() if k != "shell.low"}, str(path), metadata=meta)
    with refused("file-damaged", path, "shell.low", kind=ReconstructError):
        load_rest(path)


def test_damaged_motion_is_refused(tmp_path: Path) -> None:
    path, model = tmp_path / "motion.safetensors", random_model()
    assert model.motion is not None
    save_motion(path, model.motion, 0.01)
    with safe_open(str(path), framework="pt") as file:
        meta = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    stream = tensors["forward.stream"]
    bomb = torch.frombuffer(bytearray(zlib.compress(bytes(10**7))), dtype=torch.uint8)
    damaged = {
        "cut": {"forward.stream": stream[:-9].contiguous()},
        "other bytes": {"forward.stream": 255 - stream},
        "more than the field holds": {
            "forward.stream": bomb,
            "forward.ends": torch.tensor([len(bomb)] * len(tensors["forward.ends"])),
        },
        "too few parts": {"forward.ends": tensors["forward.ends"][:-1].contiguous()},
    }
    for parts in damaged.values():
        save_file(tensors | parts, str(path), metadata=meta)
        with refused("file-damaged", path, " fit ", kind=ReconstructError):
            load_motion(path)


def test_empty_space_costs_nothing_and_changes_nothing(tmp_path: Path) -> None:
    """A small thing in a large box: a hundredth of the dense size, the same picture."""
    model = random_model("white")
    canonical = model.rest.canonical
    canonical.density.fill_(-10.0)
    canonical.density[6:9, 6:9, 6:9] = 9.0
    canonical.rebuild_occupancy()
    save_rest(tmp_path / FILE, model.rest)
    again = load_rest(tmp_path / FILE)
    assert torch.equal(again.canonical.distance, canonical.distance)
    assert (tmp_path / FILE).stat().st_size < 0.5 * canonical.features.numel() * 2
    before, after = (
        render_view(DynamicModel(rest), before_random_model(), None) for rest in (model.rest, again)
    )
    np.testing.assert_allclose(before, after, atol=0.01)
    assert before.std() > 0.05


def test_surroundings_are_the_same_where_rays_end_on_the_cube(tmp_path: Path) -> None:
    """Where nothing is met, the colour of the cube's face is seen: its vertices are kept, too."""
    model = random_model()
    assert model.rest.shell is not None
    model.rest.shell.grid[..., 0] = -10.0
    model.rest.shell.rebuild_occupancy()
    save_rest(tmp_path / FILE, model.rest)
    again = load_rest(tmp_path / FILE)
    before, after = (
        render_view(DynamicModel(rest), before_random_model(), None) for rest in (model.rest, again)
    )
    np.testing.assert_allclose(before, after, atol=0.02)
