"""Pictures at other times than their clocks say."""

from dataclasses import replace

import numpy as np
import pytest
from tests.reconstruct.conftest import ball_clips

from devrf.capture.scene import Scene
from devrf.reconstruct.sampling.retimed import retimed

pytestmark = pytest.mark.full

TIMES = 9
TRAVEL = np.array([0.45, 0.0, 0.25])  # 0.064 box units, 1.5 pixels, from one picture to the next
GAP_S = 1 / (TIMES - 1)


@pytest.fixture(scope="module")
def moving(ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The ball on its way, seen by all four cameras of the ball's scene at nine times."""
    return ball_clips(ball, tmp_path_factory.mktemp("moving"), TIMES, TRAVEL)


def test_times_stay_within_what_is_modelled_and_test_views_go_along(moving: Scene) -> None:
    test = replace(moving.dynamic[0], split="test", camera_name="witness")
    scene = replace(moving, dynamic=(*moving.dynamic, test), t0_s=0.0, t1_s=1.0)
    shifted = retimed(scene, {"cam0": 0.05, "witness": 0.02})
    before, after = ([f for f in s.dynamic if f.camera_name == "cam0"] for s in (scene, shifted))
    for a, b in zip(before[:-1], after, strict=True):  # the last one is beyond what is modelled
        assert b.time_s == pytest.approx((a.time_s or 0) + 0.05)
        assert b.time == pytest.approx((a.time or 0) + 0.05)
    assert shifted.dynamic[-1].time_s == pytest.approx((test.time_s or 0) + 0.02)
    assert shifted.dynamic[TIMES - 1] == scene.dynamic[TIMES]
