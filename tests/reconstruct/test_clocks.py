"""Clocks as unknowns of the model: the estimator in closed form, and a late camera found by the model."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import ball_clips
from tests.reconstruct.deaths import until_done

from devrf.capture.scene import Scene
from devrf.pipelines.clocks_in_use import clock_stds
from devrf.pipelines.stages.deformation import clock_rows
from devrf.reconstruct.clocks import (
    SHIFTS,
    Clocks,
    LearnedClock,
    error_curves,
    lowest,
    solved,
    with_clocks,
)
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.options import MotionOptions, preset
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.surroundings import PixelSurroundings
from devrf.reconstruct.train_motion import train_motion

pytestmark = pytest.mark.full

TIMES = 9
TRAVEL = np.array([0.45, 0.0, 0.25])  # 0.064 box units, 1.5 pixels, from one picture to the next
GAP_S = 1 / (TIMES - 1)
MOTION = MotionOptions(
    levels=(3, 6), iterations=(4, 3), rays=256, importance=0.8, most_keys=4, learn_clocks=True
)


@pytest.fixture(scope="module")
def moving(ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The ball on its way, seen by all four cameras of the ball's scene at nine times."""
    return ball_clips(ball, tmp_path_factory.mktemp("moving"), TIMES, TRAVEL)


def test_lowest_is_the_mean_of_what_pictures_say_and_their_scatter_its_doubt() -> None:
    """Parabolas of equal width: the minimum of their sum is the mean of theirs; its variance that of a mean."""
    own = np.array([0.1, 0.3, -0.2, 0.25])
    curves = (SHIFTS[None] - own[:, None]) ** 2 + 5
    shift, std = lowest(curves)
    assert shift == pytest.approx(own.mean(), abs=1e-9)
    assert std == pytest.approx(np.sqrt(((own - own.mean()) ** 2).sum()) / len(own), abs=1e-9)
    assert lowest(curves[:1]) == (0.0, np.inf)  # a single picture has no scatter
    assert lowest(-curves)[1] == np.inf  # no lowest error


def test_shifts_against_the_motion_give_offsets_against_the_reference() -> None:
    offset, late = np.array([0.0, 0.010, -0.004, 0.007]), 0.003  # of the motion as a whole
    shift, zero = offset - late, np.zeros(4)
    wide, tight, std = np.full(4, 1e3), np.full(4, 1e-9), np.full(4, 1e-3)
    found, found_std = solved(shift, std, zero, wide)
    np.testing.assert_allclose(found, offset, atol=1e-9)
    np.testing.assert_allclose(found_std[1:], 1e-3 * np.sqrt(2), rtol=1e-6)  # two cameras, each known to 1 ms
    np.testing.assert_allclose(
        solved(shift, std, zero, tight)[0], 0.0, atol=1e-9
    )  # what sync knows, it knows
    lost = np.array([1e-3, 1e-3, np.inf, 1e-3])  # a camera whose pictures say nothing keeps its clock
    np.testing.assert_allclose(solved(shift, lost, zero, wide)[0], offset * [1, 1, 0, 1], atol=1e-9)
    begun = np.array([0.0, 0.006, 0.0, 0.0])  # learned before: what is left adds to it
    np.testing.assert_allclose(solved(shift - begun, std, begun, wide)[0], offset, atol=1e-9)


def test_a_late_camera_is_found_where_the_motion_is_right(ball, moving: Scene, rest: RestModel) -> None:
    """cam1 is said to be 0.4 pictures later than it is, 0.6 pixels of motion; the motion is the true one.

    What is left may be 0.1 pictures: 0.15 pixels. Each of five pictures puts the ball's edge and pattern in place to
    a fifth of a voxel at rest, itself 1.1 pixels (2.4 / 40 box units at a distance of 2.6, focal length 60 pixels):
    0.3 pixels, 0.13 for their mean. Clocks that are said to be exact stay.
    """
    late = 0.4 * GAP_S
    wrong = with_clocks(moving, {"cam1": LearnedClock(late, None, 0.0)})
    motion = MotionField.still(
        torch.tensor(ball.scene.aabb).float(), 2, 4, t_first=0.0, t_last=1.0, rest_key=0, device="cpu"
    )
    motion.backward[1] -= torch.tensor(TRAVEL).float()
    rays = RaySet(wrong.dynamic, 1.0, "white")
    clocks = Clocks(wrong.dynamic, {"cam0": 0.0, "cam1": None, "cam2": 0.1 * GAP_S, "cam3": 0.0})
    assert list(clocks.learned)[0] == "cam0"
    assert clocks.learned["cam1"].prior_std_s == pytest.approx(0.5 * GAP_S)
    looked_at = replace(rest, canonical=rest.canonical.seen_with(1.0, 1e-3, 1e-3))
    around = PixelSurroundings(DynamicModel(rest), rays)
    for _ in range(2):  # the second time finds little to change
        times = rays.times[:, None] + (clocks.offsets_s[:, None] + GAP_S * torch.from_numpy(SHIFTS)).float()
        g = torch.Generator().manual_seed(0)
        clocks.update(error_curves(looked_at, motion, rays, around, changing_pixels(rays), times, g))
        found = {name: clock.offset_s / GAP_S for name, clock in clocks.learned.items()}
        assert found["cam0"] == 0.0 and abs(found["cam3"]) < 1e-3
        assert found["cam1"] == pytest.approx(-0.4, abs=0.1) and abs(found["cam2"]) < 0.1
    assert 0 < (clocks.learned["cam1"].std_s or 0) < 0.1 * GAP_S


def test_learning_resumes_in_the_middle_bit_by_bit(moving: Scene, rest: RestModel, tmp_path: Path) -> None:
    undisturbed, metrics = train_motion(moving, rest, {}, MOTION)
    deaths = {("", visits) for visits in (2, 4, 6)}
    motion, again = until_done(
        lambda state: train_motion(moving, rest, {}, MOTION, checkpoint=state), tmp_path, deaths
    )
    assert again["clocks"] == metrics["clocks"] and metrics["clocks"]["cam2"]["offset_s"] != 0
    assert torch.equal(motion.backward, undisturbed.backward)
    assert torch.equal(motion.forward, undisturbed.forward)


def test_times_stay_within_what_is_modelled_and_test_views_keep_theirs(moving: Scene) -> None:
    test = replace(moving.dynamic[0], split="test")
    scene = replace(moving, dynamic=(*moving.dynamic, test), t0_s=0.0, t1_s=1.0)
    shifted = with_clocks(scene, {"cam0": LearnedClock(0.05, None, 0.0)})
    before, after = ([f for f in s.dynamic if f.camera_name == "cam0"] for s in (scene, shifted))
    for a, b in zip(before[:-1], after[:-1], strict=True):
        assert b.time_s == pytest.approx((a.time_s or 0) + 0.05)
        assert b.time == pytest.approx(min(1.0, (a.time or 0) + 0.05))
    assert after[-1] == test and shifted.dynamic[TIMES] == scene.dynamic[TIMES]


def test_a_clock_that_sync_had_wrong_is_named() -> None:
    learned = {
        "cam0": {"offset_s": 0.0, "std_s": 0.0, "prior_std_s": 1e-6},
        "cam1": {"offset_s": -0.009, "std_s": 1e-3, "prior_std_s": 4e-3},
    }
    (found,) = clock_rows(learned)
    assert found.verdict == "warn" and found.value == pytest.approx(2.25)
    assert "cam1" in found.check and "9.0 ms earlier" in found.remedy and "capture.timestamps" in found.remedy
    learned["cam1"]["offset_s"] = 0.007
    assert [r.verdict for r in clock_rows(learned)] == ["ok"]
    assert clock_rows({}) == []


def test_priors_are_those_of_the_clocks_in_use_the_reference_first(tmp_path: Path) -> None:
    assert clock_stds(tmp_path) == {}  # a data set has none
    cameras = {"cam0": {"std_s": 0.0}, "b": {"std_s": 2e-3}, "a": {"std_s": None}}
    (tmp_path / "sync").mkdir()
    (tmp_path / "sync" / "sync.json").write_text(json.dumps({"cameras": cameras}))
    assert list(clock_stds(tmp_path).items()) == [("cam0", 0.0), ("b", 2e-3), ("a", None)]


def test_learning_is_off_by_default() -> None:
    for name in ("tiny", "fast", "reference"):
        assert not preset(name).motion.learn_clocks
        assert preset(name, learn_clocks=True).motion.learn_clocks
