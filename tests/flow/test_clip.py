"""A clip's flow: direction, size, gaps and what it says about itself."""

import cv2
import numpy as np
import pytest

from devrf.capture.errors import FlowError
from devrf.flow.clip import clip_flow
from devrf.flow.dis import DisFlow

STEP = (5.0, -2.0)  # motion of the square per frame: right and up


class Swapped:
    """A method that mixes up its two pictures."""

    name = "swapped"

    def estimate(self, image0, image1):
        return DisFlow().estimate(image1, image0)


@pytest.fixture(scope="module")
def clip() -> list[np.ndarray]:
    """Six pictures [120, 160, 3]: a textured square moves over a textured wall that is at rest."""
    rng = np.random.default_rng(0)
    wall, square = (
        cv2.resize(rng.integers(20, 235, (h, w, 3)).astype(np.uint8), (5 * w, 5 * h))
        for h, w in ((24, 32), (12, 12))
    )
    pictures = []
    for n in range(6):
        picture = wall.copy()
        x, y = 20 + int(n * STEP[0]), 40 + int(n * STEP[1])
        picture[y : y + 60, x : x + 60] = square
        pictures.append(picture)
    return pictures


def test_flow_is_backward_and_in_pixels_of_the_stored_size(clip):
    flow, checks = clip_flow("cam0", [3, 4, 6], [0.0, 1.0, 2.0], clip.__getitem__, (80, 40), DisFlow())
    assert flow.index.tolist() == [4, 6] and flow.flow.shape == (2, 40, 80, 2)
    inside = flow.flow[1, 15:26, 22:38].astype(np.float32).reshape(-1, 2)  # well inside the square, reduced
    # backward: the content came from the left and from below; x is halved, y is a third
    np.testing.assert_allclose(np.median(inside, axis=0), [-STEP[0] / 2, -STEP[1] / 3], atol=0.1)
    wall = flow.flow[:, :, 65:].astype(np.float32)[flow.valid[:, :, 65:]]
    assert np.abs(wall).mean() < 0.1
    assert checks.pairs == 2 and checks.gaps == 0


def test_checks_of_a_good_clip(clip):
    _, checks = clip_flow("cam0", range(6), np.arange(6.0), clip.__getitem__, (160, 120), DisFlow())
    assert checks.valid is not None and checks.valid > 0.9 and checks.large == 0
    assert checks.moving == pytest.approx(60 * 60 / (120 * 160), rel=0.3)
    assert checks.warp_ratio is not None and checks.warp_ratio < 0.2
    assert checks.round_trip_px is not None and checks.round_trip_px < 0.2


def test_swapped_direction_is_seen_by_warping(clip):
    _, checks = clip_flow("cam0", range(6), np.arange(6.0), clip.__getitem__, (160, 120), Swapped())
    assert checks.warp_ratio is not None and checks.warp_ratio > 0.9


def test_nothing_valid_across_a_gap(clip):
    time = [0.0, 0.1, 0.2, 0.41, 0.5, 0.6]
    flow, checks = clip_flow("cam0", range(6), time, clip.__getitem__, (160, 120), DisFlow())
    assert checks.gaps == 1 and checks.pairs == 4
    assert flow.index[2] == 3 and not flow.valid[2].any() and not flow.flow[2].any()
    assert flow.valid[[0, 1, 3, 4]].any(axis=(1, 2)).all()


def test_nothing_moves_is_not_an_error(clip):
    _, checks = clip_flow("cam0", [0, 1], [0.0, 1.0], lambda n: clip[0], (160, 120), DisFlow())
    assert checks.moving == 0 and checks.warp_ratio is None and checks.valid == 1 == checks.supported


@pytest.mark.parametrize("time", [[0.0], [0.0, 0.0], [1.0, 0.5]])
def test_times_must_rise(clip, time):
    with pytest.raises(FlowError, match="cam0.*rising"):
        clip_flow("cam0", range(len(time)), time, clip.__getitem__, (160, 120), DisFlow())


def test_size_change_is_named(clip):
    pictures = [clip[0], clip[1][:100]]
    with pytest.raises(FlowError, match="frame 8 is 160x100"):
        clip_flow("cam0", [7, 8], [0.0, 1.0], pictures.__getitem__, (160, 120), DisFlow())
