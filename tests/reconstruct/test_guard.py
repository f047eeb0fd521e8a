"""Trainings that run away are caught, go on from their last good point, and say so."""

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import REST, look_at
from tests.reconstruct.deaths import until_done
from tests.refused import refused

from devrf.capture.scene import PosedFrame
from devrf.capture.system.errors import ReconstructError
from devrf.pipelines.health.judge import judge
from devrf.pipelines.health.training_rows import contradicted_measures, restart_measures
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.training import fine_tune as fine_tuning
from devrf.reconstruct.training.guard import MOST, SMALLER, Guard
from devrf.reconstruct.training.loop import Step, TrainingRun
from devrf.reconstruct.training.train_canonical import _Recipe as RestRecipe
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import _Key, train_motion

QUICK = replace(REST, iterations=30, scale_at=(0.5,), occupancy_every=10)
MOTION = MotionOptions(
    levels=(4,), iterations=(25,), rays=300, importance=0.7, lr=6e-3, most_keys=3, weight_threshold=1e-3
)


@pytest.fixture(scope="module")
def good_rest(ball) -> RestModel:
    """Trained with steps of the right size."""
    return train_canonical(ball.scene, QUICK)


@pytest.fixture(scope="module")
def good_motion(ball, rest: RestModel) -> tuple[MotionField, dict[str, Any]]:
    """The same of the motion, and what training measured."""
    return train_motion(ball.scene, rest, {}, MOTION)


def _losses(guard: Guard, *losses: float) -> list[bool]:
    log = TrainingLog("cpu", 1000)
    return [guard.ran_away(log, 1, {"mse": torch.tensor(loss)}) for loss in losses]


def test_a_loss_that_doubles_has_run_away() -> None:
    guard = Guard()
    assert not any(_losses(guard, *[1.0] * 5, *[1.9] * 5))
    assert _losses(guard, *[2.1] * 5) == [False] * 4 + [True]
    guard.begin()
    assert not any(_losses(guard, *[2.1] * 10))  # compared with nothing before


def test_single_batches_may_be_bad() -> None:
    assert not any(_losses(Guard(), 1.0, 9.0, 1.0, 1.0, 9.0, 0.9))


def _trained(spread: float, count: int, seed: int) -> list[float]:
    """Losses of a training that goes well, whose batches differ by chance: little as long as all is to be learned."""
    rng, left = np.random.default_rng(seed), np.exp(-np.arange(count) / 30)
    return ((0.06 * left + 3e-4) * np.exp(spread * (1 - left) * rng.normal(size=count))).tolist()


@pytest.mark.parametrize("spread", [0.02, 0.1, 0.25, 0.4])
def test_batches_that_differ_by_chance_have_not_run_away(spread: float) -> None:
    """0.4: the largest of a hundred is five times the smallest, or more."""
    assert not any(any(_losses(Guard(), *_trained(spread, 600, seed))) for seed in range(20))


@pytest.mark.parametrize(("spread", "leap"), [(0.02, 2.5), (0.1, 2.5), (0.25, 8.0), (0.4, 20.0)])
def test_a_leap_beyond_chance_is_caught(spread: float, leap: float) -> None:
    for seed in range(20):
        losses = _trained(spread, 400, seed)
        guard = Guard()
        assert not any(_losses(guard, *losses[:300]))
        assert any(_losses(guard, *(leap * loss for loss in losses[300:350])))


def test_cameras_of_other_errors_are_no_chance() -> None:
    """They take turns, and one of them is fitted a hundred times worse."""
    guard = Guard()
    guard.look_every = 6
    assert not any(_losses(guard, *[1.0, 0.01, 0.02] * 40))
    assert any(_losses(guard, *[2.5, 0.025, 0.05] * 2))


def test_no_number_has_run_away() -> None:
    guard = Guard()
    assert _losses(guard, 1.0, 1.0, float("nan"), 1.0, 1.0)[-1]
    guard.begin()
    assert _losses(guard, float("inf")) == [True]


def test_steps_get_smaller_only_so_often_at_one_point() -> None:
    guard, log = Guard(), TrainingLog("cpu", 10)
    assert all(guard.go_back(log, "here") for _ in range(MOST))
    assert guard.rate == pytest.approx(SMALLER**MOST)
    assert not guard.go_back(log, "here") and guard.rate == 1.0  # it is not the steps
    guard.good_point()
    assert guard.go_back(log, "there") and guard.restarts == MOST + 1


def test_one_odd_part_does_not_slow_the_others_and_two_do() -> None:
    guard, log = Guard(), TrainingLog("cpu", 10)
    guard.other_part()
    guard.go_back(log, "first")
    guard.other_part()
    assert guard.rate == 1.0
    guard.go_back(log, "second")
    guard.other_part()
    assert guard.rate == pytest.approx(SMALLER)
    assert guard.summary() == {"restarts": 2, "rate": pytest.approx(SMALLER)}


def test_what_only_gets_worse_was_trained_with_no_rate() -> None:
    guard, log = Guard(), TrainingLog("cpu", 10)
    guard.other_part()
    while guard.go_back(log, "here"):
        pass
    guard.other_part()
    assert guard.summary() == {"restarts": MOST, "rate": 1.0}


def test_pictures_are_compared_with_themselves() -> None:
    """Windows of fine-tuning: one lies near rest, where errors are small."""
    guard = Guard()
    for window, loss in [("0", 0.0005), ("1", 0.002), ("0", 0.0005), ("1", 0.002)]:
        guard.turn_to(window)
        assert not any(_losses(guard, *[loss] * 10))
    assert any(_losses(guard, *[0.005] * 5))


def test_a_leap_that_no_look_has_seen_is_not_sound() -> None:
    guard = Guard()
    assert guard.sound()
    assert not any(_losses(guard, *[0.01] * 8, 1.0)) and guard.sound()  # one batch may be bad
    assert not any(_losses(guard, 1.0)) and not guard.sound()
    guard.begin()
    assert not any(_losses(guard, 1.0, 1.0, float("nan"))) and not guard.sound()


def test_a_good_point_remembers_how_low_the_loss_was_there() -> None:
    guard, log = Guard(), TrainingLog("cpu", 10)
    _losses(guard, *[1.0] * 5)
    guard.good_point()
    _losses(guard, *[0.1] * 5)
    guard.go_back(log, "here")
    assert not any(_losses(guard, *[1.0] * 5))  # as at the good point, though lower since
    assert _losses(guard, *[2.1] * 5)[-1]


def test_a_leap_is_not_kept_as_a_good_point(
    ball, good_rest: RestModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Filled two steps before the point at iteration 10, between two looks."""
    step, steps = RestRecipe.step, count(1)

    def filled(recipe: RestRecipe, *args: Any) -> Step:
        parts = step(recipe, *args)
        if next(steps) == 8:
            recipe.canonical.density.fill_(50.0)
        return parts

    monkeypatch.setattr(RestRecipe, "step", filled)
    caught = train_canonical(ball.scene, QUICK)
    assert caught.metrics["restarts"] == 1
    assert (
        caught.metrics["train_psnr"] > good_rest.metrics["train_psnr"] - 3
    )  # so few steps, and now smaller ones


def test_cameras_that_take_turns_may_differ(ball, rest: RestModel, tmp_path: Path) -> None:
    """One of them looks away, and fits perfectly from the beginning."""
    path, camera = tmp_path / "away.png", look_at(np.array([2.6, 0.5, 0.6]))
    R = look_at(-camera.centre).cam_from_world[:, :3]
    away = replace(camera, cam_from_world=np.column_stack([R, -R @ camera.centre]))
    cv2.imwrite(str(path), np.zeros((camera.height, camera.width, 4), np.uint8))
    times = sorted({f.time for f in ball.scene.dynamic if f.time is not None})
    frames = [PosedFrame(path, away, "a", n, time, time, "train") for n, time in enumerate(times)]
    scene = replace(ball.scene, dynamic=(*frames, *ball.scene.dynamic))
    _, metrics = train_motion(scene, rest, {}, replace(MOTION, one_camera=True, importance=0.0))
    assert metrics["restarts"] == metrics["keys_left"] == 0


@pytest.mark.full
def test_the_scene_at_rest_comes_through_steps_thirty_times_too_large(
    ball, good_rest: RestModel, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As well as with the right ones, to 1.5 dB; and bit by bit the same if it is killed on the way."""
    assert good_rest.metrics["restarts"] == 0
    wild = replace(QUICK, learning_rate=30 * QUICK.learning_rate)
    caught = train_canonical(ball.scene, wild)
    assert caught.metrics["restarts"] >= 1 and "0.33 times" in caplog.text
    assert caught.metrics["train_psnr"] > good_rest.metrics["train_psnr"] - 1.5
    deaths = {("", done) for done in (2, 4, 11, 17)}
    again = until_done(
        lambda state: train_canonical(ball.scene, wild, run=TrainingRun(checkpoint=state)), tmp_path, deaths
    )
    assert torch.equal(caught.canonical.density, again.canonical.density)
    assert again.metrics["restarts"] == caught.metrics["restarts"]


@pytest.mark.full
def test_motion_comes_through_steps_a_hundred_times_too_large(
    ball, rest: RestModel, good_motion: tuple[MotionField, dict[str, Any]], tmp_path: Path
) -> None:
    _, good = good_motion
    assert good["restarts"] == good["keys_left"] == 0
    wild = replace(MOTION, lr=100 * MOTION.lr)
    motion, caught = train_motion(ball.scene, rest, {}, wild)
    assert caught["restarts"] >= 1 and caught["keys_left"] == 0
    assert caught["train_psnr"] > good["train_psnr"] - 1.5
    again, _ = until_done(
        lambda state: train_motion(ball.scene, rest, {}, wild, run=TrainingRun(checkpoint=state)),
        tmp_path,
        {("", 1)},
    )
    assert torch.equal(motion.backward, again.backward)


def test_fine_tuning_goes_back_to_the_scene_at_rest(ball, rest: RestModel) -> None:
    motion, _ = train_motion(ball.scene, rest, {}, replace(MOTION, iterations=(10,)))
    options = replace(MOTION, fine_tuning=20, learning_rate=1e4)
    tuned = fine_tuning.fine_tune(ball.scene, rest, motion, options)
    assert tuned.metrics["restarts"] >= 1 and tuned.metrics["rate"] < 1
    assert (tuned.gain_db or 0) > -3  # no more than doubles the error: else it would have gone back again


@pytest.mark.full
def test_losses_that_double_by_chance_change_nothing(
    ball,
    rest: RestModel,
    good_motion: tuple[MotionField, dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    motion, _ = good_motion
    monkeypatch.setattr("devrf.reconstruct.training.guard.RUNAWAY", 0.0)
    again, metrics = train_motion(ball.scene, rest, {}, MOTION)
    assert metrics["restarts"] == metrics["keys_left"] == 0 and torch.equal(motion.backward, again.backward)


@pytest.mark.full
def test_a_motion_that_is_no_number_is_not_kept(
    ball, rest: RestModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no ray looks that is asked."""
    step, steps = _Key.step, count(1)

    def spoilt(key: _Key) -> dict[str, torch.Tensor]:
        parts = step(key)
        if next(steps) == 3:
            key.window.backward[key.key, 0, 0, 0] = float("nan")
        return parts

    monkeypatch.setattr(_Key, "step", spoilt)
    motion, metrics = train_motion(ball.scene, rest, {}, MOTION)
    assert metrics["restarts"] == 1 and motion.backward.isfinite().all()


@pytest.mark.full
def test_what_smaller_steps_do_not_help_ends_with_a_message(
    ball, rest: RestModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("devrf.reconstruct.training.guard.RUNAWAY", 0.0)
    with refused("training-diverged", "reconstruct.resolution", kind=ReconstructError):
        train_canonical(ball.scene, QUICK)
    monkeypatch.setattr("devrf.reconstruct.training.train_motion.WORSE", 0.0)
    motion, metrics = train_motion(ball.scene, rest, {}, MOTION)
    assert metrics["keys_left"] == motion.keys - 1  # a key that only gets worse stays as it was
    assert (motion.backward == 0).all() and metrics["rate"] == 1.0


def test_health_says_so_and_is_silent_where_nothing_happened() -> None:
    assert list(restart_measures({"restarts": 0, "rate": 1.0, "keys_left": 0})) == []
    ran_away, left = judge(restart_measures({"restarts": 2, "rate": 1 / 9, "keys_left": 3}))
    assert (ran_away.verdict, ran_away.value) == ("warn", 2.0) and "0.11" in ran_away.remedy
    assert left.verdict == "warn" and " 3 key times" in str(left.value)
    # nothing was trained with smaller steps
    (left,) = judge(restart_measures({"restarts": MOST, "rate": 1.0, "keys_left": 1}))
    assert " 1 key times" in str(left.value) and "smaller" not in left.remedy
    assert contradicted_measures({}) == []
    (ok,) = judge(contradicted_measures({"cam0": 0.1, "cam1": 0.35}))
    assert (ok.verdict, ok.about) == ("ok", "cam1")
    (bad,) = judge(contradicted_measures({"cam0": 0.9, "cam1": 0.35}))
    assert (bad.verdict, bad.about) == ("warn", "cam0") and "--force flow" in bad.remedy
