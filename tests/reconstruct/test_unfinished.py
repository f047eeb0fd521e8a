"""Models in training are looked at through their checkpoints, while these go on being replaced."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import Ball
from tests.reconstruct.test_resuming import MOTION, SHORT
from tests.refused import refused

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.storage.unfinished import motion_in_training, rest_in_training
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion


@pytest.mark.parametrize("background", ["white", "shell"])
def test_what_is_seen_of_a_scene_at_rest_is_what_is_being_trained(
    ball: Ball, tmp_path: Path, background: str
) -> None:
    scene = replace(ball.scene, background=background)
    camera, path = scene.static[0].camera, tmp_path / "state"
    seen: list[np.ndarray] = []

    def look(model: RestModel, seconds: float) -> None:
        if path.exists() and not seen:
            seen.append(render_view(DynamicModel(model), camera, None))
            seen.append(render_view(DynamicModel(rest_in_training(path)), camera, None))

    options = replace(SHORT, iterations=12, scale_at=(), coarse_iterations=4)
    train_canonical(
        scene, options, run=TrainingRun(checkpoint=Checkpoint(path, every_s=0.0), watch=Watch(0.0, look))
    )
    shown, looked_at = seen
    assert shown.std() > 0.01
    assert np.abs(shown - looked_at).max() < 0.2  # one iteration later
    assert -10 * np.log10(((shown - looked_at) ** 2).mean()) > 35


def test_what_is_seen_of_a_motion_is_what_is_being_trained(
    ball: Ball, rest: RestModel, tmp_path: Path
) -> None:
    path = tmp_path / "state"
    motion, _ = train_motion(
        ball.scene, rest, {}, MOTION, run=TrainingRun(checkpoint=Checkpoint(path, every_s=0.0))
    )
    seen = motion_in_training(path)
    assert torch.equal(seen.backward, motion.backward) and torch.equal(seen.forward, motion.forward)
    assert (seen.t_first, seen.t_last, seen.rest_key) == (motion.t_first, motion.t_last, motion.rest_key)
    assert torch.equal(seen.aabb, motion.aabb)
    with refused("checkpoint-without-model", path, kind=ReconstructError):
        rest_in_training(path)


def test_what_is_no_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "state"
    with refused("file-unreadable", path, kind=ReconstructError):
        rest_in_training(path)
    path.write_bytes(b"half written")
    with refused("file-unreadable", path, kind=ReconstructError):
        motion_in_training(path)
