"""No more model than a scene needs: voxels, key times, levels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.make.models import canonical
from tests.reconstruct.conftest import REST
from tests.reconstruct.deaths import until_done

from devrf.capture.camera import Camera
from devrf.capture.scene import load_image
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.key_times import BENT_PX, FARTHEST, fewer_keys, needed_spacing, rest_key_of
from devrf.reconstruct.adapt.sizing import fewer_voxels, levels_for, needed_resolution
from devrf.reconstruct.adapt.static_keys import still_keys
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import grid_shape
from devrf.reconstruct.fields.ndc import CUBE, Ndc
from devrf.reconstruct.options import MotionOptions, Overrides, preset
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

MOTION = MotionOptions(
    levels=(4, 6, 8), iterations=(90, 30, 20), rays=400, resolution=40, importance=0.7, lr=6e-3,
    weight_threshold=1e-3, adapt=True,
)  # fmt: skip


def _clip(steps: np.ndarray, width: int = 48, name: str = "cam0") -> CameraFlow:
    """Flow of a camera whose whole picture moves by `steps` [N, 2] pixels from frame to frame."""
    flow = np.broadcast_to(steps[:, None, None], (len(steps), 24, width, 2)).astype(np.float16)
    return CameraFlow(name, np.arange(1, len(steps) + 1), flow, np.ones(flow.shape[:3], bool))


def _straight(n: int, step: float) -> np.ndarray:
    return np.tile([[-step, 0.0]], (n, 1))


def test_voxels_are_as_large_as_pixels() -> None:
    pose = np.column_stack([np.eye(3), [0.0, 0.0, 4.0]])
    cameras = [Camera(320, 240, np.diag([f, f, 1.0]), pose) for f in (100.0, 200.0, 400.0)]
    box = torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])
    resolution, pixel = needed_resolution(cameras, box)
    assert pixel == pytest.approx(4.0 / 200)  # of the middle camera
    assert resolution == np.ceil(4 ** (1 / 3) / 0.02)  # the cube root of the box's volume


def test_voxels_of_a_frustum_are_as_large_as_pixels() -> None:
    offered = preset("fast", forward=True)
    K = np.array([[100.0, 0, 64], [0, 100, 36], [0, 0, 1]])
    cameras = [Camera(128, 72, K, np.eye(4)[:3]) for _ in range(3)]
    options, decision = fewer_voxels(offered.canonical, cameras, CUBE, Ndc(0.64, 0.36))
    x, y, z = grid_shape(CUBE, options.resolution, options.planes)
    assert x == y and x * y == pytest.approx(128 * 72, rel=0.05)  # cells across the frustum, and pixels
    assert z / x == pytest.approx(offered.canonical.planes / grid_shape(CUBE, 192, 96)[0], rel=0.05)
    assert decision is not None and "1/96" in decision.reason
    large = [replace(camera.scaled(6.0), width=768) for camera in cameras]
    assert fewer_voxels(offered.canonical, large, CUBE, Ndc(0.64, 0.36)) == (offered.canonical, None)


def test_motion_of_a_frustum_follows_its_voxels() -> None:
    motion = preset("fast", forward=True).motion
    for ratio in (1.0, 0.5):
        given = preset("fast", Overrides(resolution=round(160 * ratio)), forward=True)
        rest = given.canonical
        model = canonical(CUBE, rest.resolution, planes=rest.planes, ndc=Ndc(1.0, 1.0))
        assert levels_for(motion, model).levels == tuple(round(level * ratio) for level in motion.levels)
        assert levels_for(given.motion, model) == given.motion


@pytest.mark.parametrize(
    ("begin", "acceleration", "pictures"),
    [(1.0, 0.1, 6), (1.0, 0.5, 6), (1.0, 2.0, 6), (0.1, 0.01, 40)],  # the last: half a pixel in four pictures
)
def test_key_times_follow_how_much_ways_bend(begin: float, acceleration: float, pictures: int) -> None:
    """What is slow is followed over more pictures, and known less well."""
    steps = np.stack([-begin - acceleration * np.arange(pictures), np.zeros(pictures)], axis=1)
    found = needed_spacing({"cam0": _clip(steps, width=3200)})
    rel = 0.02 if begin == 1 else 0.05
    assert found is not None and found[0] == pytest.approx(np.sqrt(8 * BENT_PX / acceleration), rel=rel)


@pytest.mark.parametrize(
    ("rest_time", "key"), [(0.0, 0), (0.09, 0), (0.1, 1), (0.19, 1), (0.5, 5), (0.81, 9), (0.9, 9), (1.0, 10)]
)
def test_at_the_key_time_of_the_rest_nothing_has_moved_yet_or_any_more(rest_time: float, key: int) -> None:
    """What lasts from the start to this time lasts at the key before; what lasts from it on, at the key after."""
    assert rest_key_of(rest_time, [0.0, 0.3, 1.0], 11) == key
    assert rest_key_of(0.0, [0.2, 1.0], 11) == 0 and rest_key_of(1.0, [0.2, 0.9], 11) == 10


def test_a_short_straight_way_needs_two_key_times() -> None:
    keys, decision = fewer_keys({"cam0": _clip(_straight(19, 1.5), width=600)}, 20)
    assert keys == 2 and str(decision).startswith("key times: 2 instead of 20")


def test_a_long_straight_way_is_followed_in_steps() -> None:
    keys, decision = fewer_keys({"cam0": _clip(_straight(20, 1.5), width=100)}, 20)
    assert keys == 20 * 1.5 / (FARTHEST * 100) + 1
    assert decision is not None and "6%" in decision.reason and "4.0 pictures" in decision.reason


def test_slower_motion_takes_fewer_key_times() -> None:
    keys = [fewer_keys({"cam0": _clip(_straight(49, step), width=100)}, 50)[0] for step in (0.2, 0.4, 2.0)]
    assert keys == [3, 5, 18]
    assert fewer_keys({"cam0": _clip(_straight(49, 0.01))}, 50) == (50, None)


def test_a_wrong_vector_is_not_motion() -> None:
    slow = _clip(np.stack([-0.1 - 0.01 * np.arange(40), np.zeros(40)], axis=1), width=300)
    wrong = replace(slow, flow=slow.flow.copy())
    wrong.flow[5, 3, 6] = 9.0
    assert needed_spacing({"cam0": wrong}) == needed_spacing({"cam0": slow})


def test_flow_that_is_lost_on_the_way_says_nothing() -> None:
    flow = _clip(_straight(9, 0.1))
    flow.valid[::2, :, ::2] = False  # every second picture tells of one half only, the others of the other
    flow.valid[1::2, :, 1::2] = False
    assert needed_spacing({"cam0": flow}) is None


@pytest.mark.parametrize(
    "flows", [{}, {"cam0": _clip(_straight(9, 0.1))}, {"cam0": _clip(_straight(1, 3.0))}]
)
def test_without_flow_of_what_moves_key_times_are_not_decided(flows: dict[str, CameraFlow]) -> None:
    assert fewer_keys(flows, 10) == (10, None)


def test_flow_that_cannot_be_trusted_is_not_asked() -> None:
    steps = _straight(8, 1.0)
    flow = _clip(steps)
    flow.flow[4, :12] += 7.0  # half the picture is wrong, and known to be
    flow.valid[4, :12] = False
    assert needed_spacing({"cam0": flow}) == needed_spacing({"cam0": _clip(steps)})


def _paused(ball):
    """The ball stands still from its second to its fourth time."""
    first = {f.camera_name: f for f in ball.scene.dynamic if f.index == 1}
    dynamic = tuple(
        replace(f, path=first[f.camera_name].path) if f.index in (2, 3) else f for f in ball.scene.dynamic
    )
    return replace(ball.scene, dynamic=dynamic)


def test_key_times_without_change_take_the_motion_before(ball, rest: RestModel) -> None:
    scene = _paused(ball)
    motion, metrics = train_motion(scene, rest, {}, replace(MOTION, iterations=(3, 2, 1)))
    assert motion.keys == 5
    assert torch.equal(motion.backward[2], motion.backward[1])
    assert torch.equal(motion.forward[3], motion.forward[1])
    assert not torch.equal(motion.backward[4], motion.backward[1])
    assert any(line.startswith("key times to train: 2 instead of 4") for line in metrics["decisions"])


def test_slow_change_adds_up(ball) -> None:
    """Each picture is compared with the last that is trained on, not with its neighbour."""
    frames = tuple(f for f in ball.scene.dynamic if f.camera_name == "cam0")
    rays = RaySet(frames, 1.0, "white")
    for n in range(1, len(rays)):  # its upper rows are darker from each to the next by less than what counts
        begin, end = rays.first[n : n + 2].tolist()
        rays.pixels[begin:end] = rays.pixels[: end - begin]
        rays.pixels[begin : begin + 10 * 48] -= 4 * n
    still, _ = still_keys(rays, torch.arange(5.0), [1, 2, 3, 4], 0)
    assert still == {1, 2, 4}  # the third is 12 of 255 from the first; the fourth is like the third


@pytest.mark.full
def test_adapted_training_resumes_bit_by_bit(ball, rest: RestModel, tmp_path) -> None:
    options = replace(MOTION, iterations=(5, 3, 2))
    undisturbed, log = train_motion(_paused(ball), rest, {}, options)
    deaths = {("", visits) for visits in (1, 5, 8, 9)}  # at the others nothing moves
    motion, metrics = until_done(
        lambda state: train_motion(_paused(ball), rest, {}, options, run=TrainingRun(checkpoint=state)),
        tmp_path,
        deaths,
    )
    assert torch.equal(motion.backward, undisturbed.backward)
    assert metrics["decisions"] == log["decisions"]


@pytest.mark.full
def test_an_easy_scene_ends_up_smaller_and_faster(ball, rest: RestModel) -> None:
    """The ball's straight way, told by flow: three key times instead of five, in half the iterations."""
    step = _straight(4, 1.4)
    flows = {name: _clip(step, name=name) for name in ("cam0", "cam1", "cam2")}
    all_keys, slow = train_motion(ball.scene, rest, {}, replace(MOTION, adapt=False))
    motion, fast = train_motion(ball.scene, rest, flows, replace(MOTION, flow=0.0))
    assert motion.keys == 3 and all_keys.keys == 5
    assert fast["iterations"] <= slow["iterations"] / 2
    quality = [_test_psnr(ball, DynamicModel(rest, m)) for m in (all_keys, motion)]
    assert quality[1] > quality[0] - 2.0
    assert quality[1] > _test_psnr(ball, DynamicModel(rest)) + 3


def _test_psnr(ball, model: DynamicModel) -> float:
    errors = [
        (
            (render_view(model, f.camera, f.time) - load_image(f, 1.0, "white").astype(np.float64) / 255) ** 2
        ).mean()
        for f in ball.scene.dynamic
        if f.split == "test" and (f.time or 0) > 0.2
    ]
    return float(-10 * np.log10(np.mean(errors)))


@pytest.mark.full
def test_voxels_are_fewer_before_coarse_pictures(ball) -> None:
    scene = replace(ball.scene, image_scale=0.5)
    options = replace(REST, resolution=64, iterations=6, adapt=True)
    model = train_canonical(scene, options)
    assert model.metrics["decisions"][0].startswith("resolution at rest: ")
    assert "instead of 64" in model.metrics["decisions"][0]
    full = train_canonical(scene, replace(options, adapt=False))
    assert model.canonical.density.numel() < 0.5 * full.canonical.density.numel()
    motion, _ = train_motion(
        scene, model, {}, replace(MOTION, resolution=64, levels=(8, 32), iterations=(1, 1))
    )
    unscaled, _ = train_motion(
        scene, full, {}, replace(MOTION, resolution=64, levels=(8, 32), iterations=(1, 1))
    )
    assert motion.backward.numel() < 0.5 * unscaled.backward.numel()  # levels follow the voxels at rest


def test_what_is_given_is_not_decided() -> None:
    assert preset("fast").canonical.adapt and preset("fast").motion.adapt
    assert not preset("fast", Overrides(resolution=64)).canonical.adapt
    assert preset("fast", Overrides(key_times=7)).motion.keys == 7
    assert (
        not preset("fast", Overrides(adapt=False)).motion.adapt
        and preset("tiny", Overrides(adapt=True)).canonical.adapt
    )
    assert not preset("reference").motion.adapt


def test_given_key_times_are_kept(ball, rest: RestModel) -> None:
    flows = {"cam0": _clip(_straight(4, 2.0))}
    motion, metrics = train_motion(ball.scene, rest, flows, replace(MOTION, keys=4, iterations=(1, 1, 1)))
    assert motion.keys == 4 and not any(line.startswith("key times:") for line in metrics["decisions"])
