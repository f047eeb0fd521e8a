"""The scene at rest fine-tuned on pictures in motion: it follows their shading, and says where it gains nothing."""

import copy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.make.models import UNIT_BOX, still
from tests.reconstruct.conftest import REST, true_motion
from tests.refused import refused

from devrf.capture.scene import Scene, load_image
from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.training import fine_tune as fine_tuning
from devrf.reconstruct.training.fine_tune import LR, fine_tune
from devrf.reconstruct.training.train_canonical import train_canonical

COARSER = replace(REST, resolution=36, scale_at=(0.3,))
TUNING = MotionOptions(
    levels=(4,), iterations=(1,), rays=400, importance=0.7, adapt=True, fine_tuning=60, learning_rate=0.1 / LR
)


@pytest.fixture(scope="module", params=[False, True], ids=["colours per sample", "per ray"])
def rest(ball, request: pytest.FixtureRequest) -> RestModel:
    return train_canonical(ball.scene, replace(COARSER, deferred=request.param))


def _darker(scene: Scene, folder: Path) -> Scene:
    """The same scene whose subject is darker in pictures of the moving cameras."""
    dynamic = []
    for frame in scene.dynamic:
        picture = np.array(cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED))
        picture[..., :3] = picture[..., :3] // 2
        path = folder / frame.path.name
        cv2.imwrite(str(path), picture)
        dynamic.append(replace(frame, path=path))
    return replace(scene, dynamic=tuple(dynamic))


def _error(scene: Scene, model: DynamicModel) -> float:
    """Mean squared error of test views in motion."""
    frames = [f for f in scene.dynamic if f.split == "test" and f.time]
    pairs = [(render_view(model, f.camera, f.time), load_image(f, 1.0, "white") / 255) for f in frames]
    return float(np.mean([(a - b) ** 2 for a, b in pairs]))


@pytest.mark.full
def test_shading_in_motion_is_learned_beside_that_at_rest(ball, rest: RestModel, tmp_path: Path) -> None:
    scene, motion = _darker(ball.scene, tmp_path), true_motion(ball.scene, ball.travel)
    before = {name: getattr(rest.canonical, name).clone() for name in ("density", "features", "distance")}
    tuned = fine_tune(scene, rest, motion, TUNING)
    assert tuned.model is not None and tuned.decision is None and (tuned.gain_db or 0) > 2
    model = DynamicModel(rest, motion)
    assert _error(scene, replace(model, in_motion=tuned.model)) < 0.75 * _error(scene, model)
    for name, value in before.items():  # pictures at rest are still made of what the sweep has taught
        assert torch.equal(getattr(rest.canonical, name), value), name
    assert not any(
        p.requires_grad for p in (*rest.canonical.net.parameters(), *tuned.model.canonical.net.parameters())
    )
    again = fine_tune(scene, rest, motion, TUNING)
    assert again.model is not None
    assert torch.equal(again.model.canonical.features, tuned.model.canonical.features)


def test_where_it_gains_nothing_it_is_left_out(ball, rest: RestModel) -> None:
    motion = true_motion(ball.scene, ball.travel)
    few = replace(TUNING, fine_tuning=2, learning_rate=1e-5 / LR)
    tuned = fine_tune(ball.scene, rest, motion, few)
    assert tuned.model is None and tuned.gain_db is not None and abs(tuned.gain_db) < 0.1
    assert "none instead of 2" in str(tuned.decision) and f"{tuned.gain_db:+.2f} ± " in str(tuned.decision)
    kept = fine_tune(ball.scene, rest, motion, replace(few, adapt=False))
    assert kept.model is not None and kept.decision is None


@pytest.mark.full
def test_a_motion_too_large_for_the_device_is_taken_in_parts(
    ball, rest: RestModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, motion = _darker(ball.scene, tmp_path), true_motion(ball.scene, ball.travel)
    half = motion.backward[1:] / 2, motion.forward[1:] / 2
    motion.backward, motion.forward = (
        torch.cat([field[:1], middle, field[1:]])
        for field, middle in zip((motion.backward, motion.forward), half, strict=True)
    )
    windows = [(0, 1), (1, 2)]
    monkeypatch.setattr(fine_tuning, "_windows", lambda motion, device: windows)
    monkeypatch.setattr(fine_tuning, "WINDOW_EVERY", 5)
    tuned = fine_tune(scene, rest, motion, TUNING)
    model = DynamicModel(rest, motion)
    assert tuned.model is not None and (tuned.gain_db or 0) > 2
    assert _error(scene, replace(model, in_motion=tuned.model)) < 0.75 * _error(scene, model)


def test_parts_of_a_motion_follow_its_size() -> None:
    motion = still(UNIT_BOX, 10, 8)
    assert fine_tuning._windows(motion, "cpu") == [(0, 9)]
    assert fine_tuning._windows(motion, "cuda") == [(0, 9)]
    large = torch.empty(10, 160, 160, 160, 3, device="meta")
    assert fine_tuning._windows(replace(motion, backward=large, forward=large), "cuda") == [
        (n, n + 1) for n in range(9)
    ]


def test_a_loss_that_is_not_finite_is_an_error(ball, rest: RestModel) -> None:
    motion = true_motion(ball.scene, ball.travel)
    spoilt = replace(rest, canonical=copy.copy(rest.canonical))
    spoilt.canonical.features = torch.full_like(rest.canonical.features, float("nan"))
    with refused("training-diverged", kind=ReconstructError):
        fine_tune(ball.scene, spoilt, motion, TUNING)
