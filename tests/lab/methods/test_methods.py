"""Every method takes a step, has gradients that are right, and is as large as published."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.lab.methods.conftest import MakeTask

from devrf.capture.scene import load_image
from devrf.capture.system.errors import InputError
from devrf.lab.methods.d_nerf import DNerf
from devrf.lab.methods.field import FieldMethod, FieldTraining
from devrf.lab.methods.gaussians import DeformableGaussians
from devrf.lab.methods.method_table import METHODS
from devrf.lab.methods.pictures import Space, TaskPictures
from devrf.lab.methods.protocol import TimeBudget
from devrf.reconstruct.storage.training_log import psnr

OTHERS = [name for name in METHODS if not name.startswith("devrf")]
FIELDS = [name for name in OTHERS if name != "gaussians"]
STEPS = {
    "d-nerf": 700, "nerfies": 650, "hyper-nerf": 650, "nsff": 1100, "neural-volumes": 800, "hex-plane": 600,
    "k-planes": 500, "gaussians": 900,
}  # fmt: skip
"""In which a method learns it."""
LONG_S = 600.0  # more than the steps of a test take


@pytest.mark.parametrize("regime", ["joint", "two-stage", "dynamic"])
@pytest.mark.parametrize("name", OTHERS)
def test_a_few_steps(name: str, regime: Any, task: MakeTask) -> None:
    seen: list[float] = []
    budget = TimeBudget(LONG_S, lambda model, seconds: seen.append(seconds), steps=2)
    model = METHODS[name].load().train(task(regime), budget)
    camera = task().boxed.dynamic[0].camera
    for time in (None, 0.5):
        rgb, depth = model.render(camera, time)
        assert rgb.shape == (32, 32, 3) and depth.shape == (32, 32) and rgb.dtype == np.float32
        assert 0 <= rgb.min() <= rgb.max() <= 1 and np.isfinite(depth).all() and depth.max() < 10
    assert seen == sorted(seen) and len(seen) == 2 and model.megabytes > 0.01  # at first and at the end


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_are_what_differences_say(
    name: str, task: MakeTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the whole loss, along a random direction of all parameters; in double precision."""
    # Which points are asked whether they stretch is drawn by weights, and would jump with them.
    monkeypatch.setattr(torch, "multinomial", lambda weights, n, again: torch.arange(n) % len(weights))
    monkeypatch.setattr(torch.Tensor, "detach", lambda value: value)  # what is held fixed would move, too
    method = METHODS[name].load()
    assert isinstance(method, FieldMethod)
    torch.manual_seed(1)
    pictures = TaskPictures(task())
    # Where samples are drawn again is no part of the loss, and would move with the parameters.
    settings = replace(method.settings["small"], samples=(16, 0))
    training = FieldTraining(task(), method.make(task(), pictures), pictures, settings)
    field = training.field.double()
    field.advance(0.7)
    parameters = [p for p in field.parameters() if p.requires_grad]
    with torch.no_grad():
        for p in parameters:
            p += 1e-3 * torch.randn_like(p)
    drawn = pictures.draw(24, torch.Generator().manual_seed(0), 0.5, field.one_moment)
    floats = {name: getattr(drawn, name).double() for name in ("rays_o", "rays_d", "rgb", "time")}
    rays = replace(drawn, opacity=None, **floats)
    space = training.space
    behind = None if space.behind is None else space.behind.double()
    training.space = replace(space, low=space.low.double(), high=space.high.double(), behind=behind)

    def loss() -> torch.Tensor:
        training.generator.manual_seed(0)
        torch.manual_seed(2)
        return training.loss(rays)

    loss().backward()
    ways = [torch.randn_like(p) if p.grad is not None else torch.zeros_like(p) for p in parameters]
    along = sum(
        float((p.grad * way).sum()) for p, way in zip(parameters, ways, strict=True) if p.grad is not None
    )
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            for p, way in zip(parameters, ways, strict=True):
                p += sign * 1e-7 * way
        values.append(loss().item())
        with torch.no_grad():
            for p, way in zip(parameters, ways, strict=True):
                p -= sign * 1e-7 * way
    assert along == pytest.approx((values[0] - values[1]) / 2e-7, rel=2e-2, abs=1e-6)


@pytest.mark.parametrize("name", [n for n in OTHERS if METHODS[n].parameters is not None])
def test_as_large_as_published(name: str, task: MakeTask) -> None:
    method = METHODS[name].load()
    assert isinstance(method, FieldMethod)
    full = replace(task(), size="full")
    millions = sum(p.numel() for p in method.make(full, TaskPictures(full)).parameters()) / 1e6
    assert millions == pytest.approx(METHODS[name].parameters, rel=0.1)


@pytest.mark.full
@pytest.mark.parametrize("name", OTHERS)
def test_learns_a_small_scene_by_heart(name: str, task: MakeTask) -> None:
    """Six pictures that it was trained on, of three moments, to 30 dB."""
    model = METHODS[name].load().train(task("dynamic"), TimeBudget(LONG_S, steps=STEPS[name]))
    scene = task().boxed
    seen = [f for f in scene.dynamic if f.split == "train"]
    errors = [
        (model.render(f.camera, f.time)[0] - load_image(f, 1.0, scene.background) / 255) ** 2 for f in seen
    ]
    assert psnr(float(np.mean(errors))) > 30


def perceptron(inputs: int, outputs: int, depth: int, width: int, again: bool = True) -> int:
    """Weights and biases of hidden layers of a width, the input joined `again` in the middle, and an output."""
    hidden = inputs * width * (1 + again) + (depth - 1) * width**2 + depth * width
    return hidden + width * outputs + outputs


PLACE, DIRECTION = 3 + 3 * 2 * 10, 3 + 3 * 2 * 4  # numbers of NeRF's encodings, with what they encode
NERF = perceptron(PLACE, 256, 8, 256) + 257 + (256 + DIRECTION) * 128 + 128 + 128 * 3 + 3


@pytest.mark.parametrize(
    ("name", "part", "count"),
    [
        ("d-nerf", "canonical", NERF),
        ("d-nerf", "warp", perceptron(PLACE + 9, 3, 8, 256)),  # four frequencies of time
        ("nerfies", "canonical", NERF + 8 * 128),  # codes of appearance
        ("nerfies", "warp.motion", perceptron(3 + 3 * 2 * 8 + 8, 6, 6, 128)),
        ("hyper-nerf", "slice", perceptron(3 + 3 * 2 * 7 + 8, 2, 6, 64)),
        (
            "hyper-nerf",
            "canonical",
            NERF + 8 * 128 + 2 * 256 * (2 + 2 * 2),
        ),  # an ambient place, one frequency
        ("nsff", "stands", NERF),
        ("nsff", "moves", NERF + 2 * 256 * (1 + 2 * 10)),
        ("k-planes", "planes", 32 * sum(3 * side**2 + 3 * side * 3 for side in (64, 128, 256, 512))),
        ("hex-plane", "planes", 128 * (3 * 512**2 + 3 * 512 * 3)),
        ("neural-volumes", "affine", 257 * 12 * 16),
    ],
)
def test_parts_are_as_large_as_published_widths_say(name: str, part: str, count: int, task: MakeTask) -> None:
    """Counted by hand; planes of the three moments of the small scene."""
    method, full = METHODS[name].load(), replace(task(), size="full")
    assert isinstance(method, FieldMethod)
    module = method.make(full, TaskPictures(full)).get_submodule(part)
    assert sum(p.numel() for p in module.parameters()) == count


def test_the_network_that_moves_gaussians_is_as_large_as_published(task: MakeTask) -> None:
    """Ten frequencies of places and six of times; a shift, a quaternion and three scales."""
    full = replace(task(), size="full")
    moved = DeformableGaussians(full, Space.of(full))
    assert sum(p.numel() for p in moved.warp.parameters()) == perceptron(PLACE + 13, 3 + 4 + 3, 8, 256)


def test_networks_of_d_nerf_are_those_of_nerf() -> None:
    """NeRF's fine network has 595,844 parameters; this one has a layer fewer between trunk and colour."""
    canonical = DNerf("full").canonical
    assert 0.95 < sum(p.numel() for p in canonical.parameters()) / 595_844 < 1.05


def test_names_lead_to_methods() -> None:
    for name, entry in METHODS.items():
        assert entry.about and entry.paper and {"joint"} <= set(entry.load().regimes), name


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "devrf.lab.methods.gaussians", raising=False)
    monkeypatch.setitem(sys.modules, "kornia", None)
    with pytest.raises(InputError, match=r"needs kornia.*devrf\[methods\]"):
        METHODS["gaussians"].load()


def test_bench_methods(devrf: Any, arm: Path, tmp_path: Path) -> None:
    """Two methods, a few steps each: rows, chart, pictures; nothing is trained twice."""
    command = ("bench", "methods", arm, "--methods", "d-nerf,k-planes", "--steps", "3", "--seconds", "60",
               "--device", "cpu", "--out", str(tmp_path / "out"))  # fmt: skip
    done = devrf(*command)
    assert done.code == 0, done.said[-2000:]
    assert "methods/d-nerf/test/psnr" in done.said and "31.83" in done.said  # the paper's beside ours
    assert (tmp_path / "out" / "methods.png").is_file() and (
        tmp_path / "out" / "methods-pictures.png"
    ).is_file()
    again = devrf(*command)
    assert again.code == 0 and "seed 0: d-nerf" not in again.said


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--methods", "nerf"), "unknown, expected d-nerf"),
        (("--methods", "devrf-tiny", "--regime", "dynamic"), "has joint, two-stage"),
        (("--regime", "still"), "'still' is not one of"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    devrf: Any, arm: Path, tmp_path: Path, arguments: Any, named: str
) -> None:
    done = devrf("bench", "methods", arm, *arguments, "--device", "cpu", "--out", str(tmp_path / "out"))
    assert done.code == 2 and named in done.said
