"""Both stages learn a ball whose look and path are known, repeatably, and notice when they fail."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import REST
from tests.refused import refused
from torch import Tensor

from devrf.capture.scene import load_image, plain_colour
from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.storage.training_log import Diverged, TrainingLog
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training import train_canonical as training
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.losses import VARIATION_CLAMP
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

SHELL = replace(REST, shell_resolution=32, coarse_iterations=24, coarse_rays=512, coarse_size=32)
MOTION = MotionOptions(
    levels=(4, 8), iterations=(90, 40), rays=400, importance=0.7, lr=6e-3, weight_threshold=1e-3
)


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_scene_at_rest_is_learned(ball, rest: RestModel) -> None:
    assert (rest.canonical.aabb.abs() < 1.5 * ball.radius).all()  # the hull has found the ball
    model = DynamicModel(rest)
    for frame in ball.scene.static:
        if frame.split == "test":
            true = load_image(frame, 1.0, "white").astype(np.float64) / 255
            assert _psnr(render_view(model, frame.camera, None), true) > 22
    assert rest.metrics["iterations"] == 120
    assert rest.metrics["curve"][-1]["psnr"] > rest.metrics["curve"][0]["psnr"]


@pytest.mark.full
@pytest.mark.parametrize("background", ["black", "#336699"])
def test_any_plain_background(ball, background: str) -> None:
    """Mattes are composited on the colour, and the model sees the same colour behind the subject."""
    scene = replace(ball.scene, background=background)
    model = DynamicModel(train_canonical(scene, REST))
    frame = next(f for f in scene.static if f.split == "test")
    true = load_image(frame, 1.0, background).astype(np.float64) / 255
    rendered, colour = render_view(model, frame.camera, None), plain_colour(background)
    assert colour is not None and _psnr(rendered, true) > 20
    np.testing.assert_allclose(rendered[0, 0], colour, atol=0.02)  # a corner shows nothing but backdrop


def test_training_repeats_bit_by_bit(ball) -> None:
    short = replace(REST, iterations=12)
    first, second = (train_canonical(ball.scene, short).canonical for _ in range(2))
    assert torch.equal(first.density, second.density) and torch.equal(first.features, second.features)
    other = train_canonical(ball.scene, replace(short, seed=1)).canonical
    assert not torch.equal(first.density, other.density)


def _off_the_path(ball, motion: MotionField, time: float) -> float:
    """How far the ball's surface is from where it should be, in parts of the whole way."""
    directions = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    surface = torch.nn.functional.normalize(directions, dim=-1) * 0.9 * ball.radius
    moved = (motion.from_rest(surface, motion.tau(torch.full((200,), time))) - surface).mean(0).numpy()
    return float(np.linalg.norm(moved - abs(time) * ball.travel) / np.linalg.norm(ball.travel))


@pytest.mark.full
def test_rigid_travel_is_recovered(ball, rest: RestModel) -> None:
    """The centre's path, from the forward field at exact times that are and are not key times."""
    motion, metrics = train_motion(ball.scene, rest, {}, replace(MOTION, most_keys=4))
    assert motion.keys == 4 and motion.rest_key == 0
    assert (motion.backward[0] == 0).all() and (motion.forward[0] == 0).all()
    for time in (0.5, 0.75, 1.0):
        assert _off_the_path(ball, motion, time) < 0.2, time
    model = DynamicModel(rest, motion)
    for frame in ball.scene.dynamic:
        if frame.split == "test" and (frame.time or 0) > 0.4:
            true = load_image(frame, 1.0, "white").astype(np.float64) / 255
            moving = _psnr(render_view(model, frame.camera, frame.time), true)
            still = _psnr(render_view(model, frame.camera, None), true)
            assert moving > still + 3
    assert metrics["left_box_share"] < 0.2


@pytest.mark.full
def test_motion_leads_out_of_a_rest_in_the_middle(ball, rest: RestModel) -> None:
    """The clip is shown backward, then forward: the ball comes to its place at rest and leaves it again."""
    there = tuple(f for f in ball.scene.dynamic if f.time is not None)
    dynamic = tuple(replace(f, time=0.5 + side * (f.time or 0.0) / 2) for side in (-1, 1) for f in there)
    scene = replace(ball.scene, dynamic=tuple(sorted(dynamic, key=lambda f: f.time or 0.0)), rest_time=0.5)
    motion, _ = train_motion(scene, rest, {}, replace(MOTION, keys=7))
    assert motion.keys == 7 and motion.rest_key == 3
    assert (motion.backward[3] == 0).all() and (motion.forward[3] == 0).all()
    turned = replace(motion, t_first=-1.0, t_last=1.0)  # time is as far from the rest as in the ball's own
    for time in (-1.0, -0.5, 0.5, 1.0):
        assert _off_the_path(ball, turned, time) < 0.2, time


@pytest.mark.full
def test_what_is_at_rest_before_the_motion_is_not_trained(ball, rest: RestModel) -> None:
    """The rest lasts a while: until then nothing has moved, exactly, and no step has been taken."""
    there = tuple(f for f in ball.scene.dynamic if f.time is not None)
    before = tuple(replace(f, time=t) for t in (0.0, 0.2) for f in there if f.time == 0.0)
    after = tuple(replace(f, time=0.4 + 0.6 * (f.time or 0.0)) for f in there)
    scene = replace(ball.scene, dynamic=(*before, *after), rest_time=0.4)
    motion, metrics = train_motion(scene, rest, {}, replace(MOTION, keys=6))
    assert motion.rest_key == 2 and metrics["restarts"] == 0
    assert (motion.backward[:3] == 0).all() and (motion.forward[:3] == 0).all()
    assert metrics["iterations"] == 3 * sum(MOTION.iterations)
    assert _off_the_path(ball, replace(motion, t_first=-2 / 3), 1.0) < 0.2


@pytest.mark.full
def test_pictures_just_past_a_key_do_not_throw_the_next_one(ball, rest: RestModel) -> None:
    """Free-running cameras: two are a hundredth of the keys' spacing late, so that the next key hardly shows."""
    late = {"cam1": 0.003, "cam2": 0.003}
    dynamic = tuple(
        replace(f, time=f.time + late.get(f.camera_name, 0.0)) if f.time is not None and f.index < 4 else f
        for f in ball.scene.dynamic
    )
    motion, _ = train_motion(
        replace(ball.scene, dynamic=dynamic), rest, {}, replace(MOTION, levels=(4,), iterations=(90,))
    )
    assert motion.keys == 5
    for time in (0.25, 0.5, 0.75, 1.0):
        assert _off_the_path(ball, motion, time) < 0.25, time


def test_one_camera_in_each_step(ball, rest: RestModel) -> None:
    """As published: the cameras in turn; and any number of key times, whatever the number of iterations."""
    options = replace(MOTION, one_camera=True, importance=0.0, iterations=(7, 3), most_keys=400)
    motion, metrics = train_motion(ball.scene, rest, {}, options)
    assert motion.keys == 5 and metrics["iterations"] == 4 * 10
    assert float(motion.backward[4].abs().max()) > 0


@pytest.mark.full
def test_box_by_a_coarse_model(ball) -> None:
    """The published search finds the ball as the silhouettes do, and draws only rays that meet it."""
    options = replace(SHELL, iterations=40, box_search="coarse", coarse_iterations=350, coarse_rays=512)
    model = train_canonical(ball.scene, options)
    box = model.canonical.aabb
    assert (box[1] > 0.8 * ball.radius).all() and (box[0] < -0.8 * ball.radius).all()
    assert (box.abs() < 1.7 * ball.radius).all()


@pytest.mark.full
def test_surroundings_are_learned_without_mattes(ball) -> None:
    """The same pictures taken as a room: the white around the ball is part of the scene."""
    scene = replace(ball.scene, background="shell", aabb=np.array([[-0.7] * 3, [0.7] * 3]), far=8.0)
    model = train_canonical(scene, SHELL)
    assert model.shell is not None
    frame = next(f for f in scene.static if f.split == "test")
    true = load_image(frame, 1.0, "white").astype(np.float64) / 255
    assert _psnr(render_view(DynamicModel(model), frame.camera, None), true) > 16


def test_surroundings_are_plain_first(ball, monkeypatch: pytest.MonkeyPatch) -> None:
    """Total variation, of density a tenth as much, in all levels but the last."""
    sizes: list[int] = []

    def told(values: Tensor, grad: Tensor, vertices: Tensor, weights: Tensor, clamp: float) -> None:
        sizes.append(len(values))
        assert grad.any() and len(vertices) and clamp == VARIATION_CLAMP
        assert torch.allclose(weights * SHELL.rays / SHELL.shell_variation, torch.tensor([0.1, 1, 1, 1]))

    monkeypatch.setattr(training, "add_touched_variation", told)
    scene = replace(ball.scene, background="shell", aabb=np.array([[-0.7] * 3, [0.7] * 3]), far=8.0)
    options = replace(SHELL, iterations=10, coarse_iterations=2, scale_at=(0.3, 0.6), samples=1 << 30)
    model = train_canonical(scene, options)
    assert model.shell is not None and len(sizes) == 6
    assert len(set(sizes)) == 2 and max(sizes) < model.shell.size == model.shell.final


def test_scene_without_pictures_is_refused(ball, rest: RestModel) -> None:
    with refused("pictures-none", "in motion", kind=ReconstructError):
        train_motion(replace(ball.scene, dynamic=()), rest, {}, MOTION)
    held_out = tuple(replace(f, split="test") for f in ball.scene.static)
    with refused("pictures-none", "at rest", kind=ReconstructError):
        train_canonical(replace(ball.scene, static=held_out), REST)


def test_divergence_is_noticed() -> None:
    log = TrainingLog("cpu", 2)
    log.add(10, {"mse": torch.tensor(0.1)})
    with refused("training-diverged", "'mse'", "nan", "iteration 2", kind=Diverged):
        log.add(10, {"mse": torch.tensor(float("nan"))})


def test_looks_are_off_the_clock_and_come_less_and_less_often() -> None:
    now = [100.0]
    log, looked = TrainingLog("cpu", 10, lambda: now[0]), []

    def look(model: str, seconds: float) -> None:
        looked.append((model, seconds))
        now[0] += 1000.0  # a look takes long

    watch = Watch(2.0, look)
    for _ in range(20):
        watch(log, lambda: "model")
        now[0] += 1.0
    assert log.seconds == 20.0
    # gaps of 2, 2.3, 2.6, 3.0 and 3.5 seconds, looked at every full second
    assert [int(seconds) for _, seconds in looked] == [0, 2, 5, 8, 12, 16]


def test_looking_changes_nothing(ball, rest: RestModel) -> None:
    options = replace(MOTION, iterations=(4, 3), most_keys=3)
    watched: list[MotionField] = []
    motion, _ = train_motion(
        ball.scene, rest, {}, options, run=TrainingRun(watch=Watch(0.0, lambda m, s: watched.append(m)))
    )
    assert torch.equal(motion.backward, train_motion(ball.scene, rest, {}, options)[0].backward)
    assert len(watched) == 2 * 2  # levels times keys
