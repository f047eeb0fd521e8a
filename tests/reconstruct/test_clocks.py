"""When a camera's pictures fit the motion best: the estimator in closed form, a late camera under the true motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import ball_clips, true_motion

from devrf.capture.scene import Scene
from devrf.reconstruct.clocks import SHIFTS, error_curves, lowest, with_offset
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.surroundings import PixelSurroundings

pytestmark = pytest.mark.full

TIMES = 9
TRAVEL = np.array([0.45, 0.0, 0.25])  # 0.064 box units, 1.5 pixels, from one picture to the next
GAP_S = 1 / (TIMES - 1)


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


def test_a_late_camera_is_seen_where_the_motion_is_right(ball, moving: Scene, rest: RestModel) -> None:
    """cam1 is said to be 0.4 pictures later than it is, 0.6 pixels of motion; the motion is the true one.

    What is left may be 0.1 pictures: 0.15 pixels. Each of five pictures puts the ball's edge and pattern in place to
    a fifth of a voxel at rest, itself 1.1 pixels (2.4 / 40 box units at a distance of 2.6, focal length 60 pixels):
    0.3 pixels, 0.13 for their mean.
    """
    wrong = with_offset(moving, "cam1", 0.4 * GAP_S)
    motion = true_motion(ball.scene, TRAVEL)
    rays = RaySet(wrong.dynamic, 1.0, "white")
    looked_at = replace(rest, canonical=rest.canonical.seen_with(1.0, 1e-3, 1e-3))
    around = PixelSurroundings(DynamicModel(rest), rays)
    names, changing = [f.camera_name for f in wrong.dynamic], changing_pixels(rays)
    offset, std = 0.0, np.zeros(4)
    for _ in range(2):  # the second time finds little to change
        pictures = SHIFTS + offset * np.array([[name == "cam1"] for name in names])
        times = rays.times[:, None] + (GAP_S * torch.from_numpy(pictures)).float()
        g = torch.Generator().manual_seed(0)
        curves = error_curves(DynamicModel(looked_at, motion), rays, around, changing, times, g)
        known = np.isfinite(curves).all(1)
        found = [
            lowest(curves[known & (np.array(names) == name)]) for name in ("cam1", "cam0", "cam2", "cam3")
        ]
        shift, std = np.array(found).T
        offset += shift[0] - np.average(shift[1:], weights=std[1:] ** -2.0)  # a motion may be late as a whole
    assert offset == pytest.approx(-0.4, abs=0.1) and 0 < std[0] < 0.11


def test_times_stay_within_what_is_modelled_and_test_views_keep_theirs(moving: Scene) -> None:
    test = replace(moving.dynamic[0], split="test")
    scene = replace(moving, dynamic=(*moving.dynamic, test), t0_s=0.0, t1_s=1.0)
    shifted = with_offset(scene, "cam0", 0.05)
    before, after = ([f for f in s.dynamic if f.camera_name == "cam0"] for s in (scene, shifted))
    for a, b in zip(before[:-1], after[:-1], strict=True):
        assert b.time_s == pytest.approx((a.time_s or 0) + 0.05)
        assert b.time == pytest.approx(min(1.0, (a.time or 0) + 0.05))
    assert after[-1] == test and shifted.dynamic[TIMES] == scene.dynamic[TIMES]
