"""Pixels that training leaves out: which they are, of which pictures, and what a gain on them is worth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import TRAVEL, Ball, ball_clips

from devrf.capture.scene import Scene
from devrf.reconstruct.evaluation.left_out import ONE_IN, PER_PICTURE, LeftOut, left_out
from devrf.reconstruct.evaluation.left_out_errors import Errors
from devrf.reconstruct.evaluation.paired import gain_text
from devrf.reconstruct.rendering.rays import RaySet

TIMES = 40
CAMERAS = ("cam0", "cam1", "cam2", "cam3")


@pytest.fixture(scope="module")
def clips(ball: Ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return ball_clips(ball, tmp_path_factory.mktemp("clips"), TIMES, TRAVEL)


def test_pixels_left_out_are_never_trained_on(ball: Ball) -> None:
    rays = RaySet(tuple(f for f in ball.scene.dynamic if f.split == "train"), 1.0, "white")
    some, generator = LeftOut(rays, None), torch.Generator().manual_seed(0)
    batch = rays.draw(20_000, generator)
    kept = some.without(batch)
    assert not left_out(kept.frame, kept.pixel).any()
    assert len(kept.rgb) == pytest.approx(20_000 * (1 - 1 / ONE_IN), rel=0.01)
    asked = some.rays_of(torch.tensor([0, 3]))
    assert asked is not None and left_out(asked.frame, asked.pixel).all()
    assert set(asked.frame.tolist()) == {0, 3} and len(asked.rgb) > 2 * 48 * 40 / ONE_IN / 2
    assert len(asked.rgb) <= 2 * PER_PICTURE


@pytest.mark.parametrize("in_turn", [True, False])
def test_every_camera_is_asked_evenly(clips: Scene, in_turn: bool) -> None:
    """Of a data set that lists its cameras in turn every fourth picture is one camera's."""
    frames = sorted(clips.dynamic, key=lambda f: (f.time, f.camera_name)) if in_turn else clips.dynamic
    rays = RaySet(tuple(frames), 1.0, "white")
    asked = [rays.frames[n] for n in LeftOut(rays, None).asked().tolist()]
    assert len(asked) == TIMES
    for name in CAMERAS:
        at = sorted(f.index for f in asked if f.camera_name == name)
        assert len(at) == TIMES // 4 and at[0] == 0 and at[-1] == TIMES - 1 and set(np.diff(at)) <= {4, 5}


def test_short_clips_are_asked_whole(clips: Scene) -> None:
    rays = RaySet(tuple(f for f in clips.dynamic if f.index < 8), 1.0, "white")
    assert LeftOut(rays, None).asked().tolist() == list(range(32))
    assert LeftOut(rays, None, torch.arange(1, 20)).asked().tolist() == list(range(1, 20))


def errors(mse: np.ndarray, first: int = 0) -> Errors:
    """Of a camera's pictures from `first` on."""
    at = np.arange(len(mse)) + first
    return Errors(tuple(("cam0", int(n)) for n in at), at / 100, mse, np.full(len(mse), 10))


@pytest.mark.parametrize(("better_by", "side"), [(1.02, 1), (1.0, 0), (1 / 1.02, -1)])
def test_a_gain_counts_where_it_is_more_than_chance(better_by: float, side: int) -> None:
    """Both meet each picture as well as it can be met, which differs severalfold, and apart from that to a percent."""
    rng = np.random.default_rng(0)
    each = 0.01 * rng.uniform(0.2, 5.0, 40)
    one, other = errors(each * rng.normal(1, 0.01, 40)), errors(better_by * each * rng.normal(1, 0.01, 40))
    gain = one.gain_over(other)
    assert gain.side() == side
    assert gain.mean == pytest.approx(10 * np.log10(better_by), abs=0.03)
    assert gain_text(gain) == f"{gain.mean:+.2f} ± {gain.half:.2f} dB"


def test_what_is_better_for_a_while_only_is_no_clear_gain() -> None:
    """Forty pictures, but they say one thing: ten in a row are better by 3 dB."""
    mse = np.full(40, 0.01)
    with_it = np.where(np.arange(40) < 10, 0.005, mse)
    assert errors(with_it).gain_over(errors(mse)).side() == 0
    few = errors(mse[:7] / 2).gain_over(errors(mse[:7]))
    assert few.side() == 0 and "too few" in gain_text(few)


def test_pictures_of_both_are_compared_and_all_pixels_averaged() -> None:
    one, other = errors(np.full(20, 0.01)), errors(np.r_[np.full(18, 0.02), 9.0, 9.0], first=2)
    assert one.gain_over(other).mean == pytest.approx(10 * np.log10(2))
    assert one.gain_db(replace(one, mse=2 * one.mse)) == pytest.approx(10 * np.log10(2))
    uneven = replace(one, pixels=np.r_[181, np.full(19, 1)], mse=np.r_[0.02, np.full(19, 0.04)])
    assert uneven.mean == pytest.approx((181 * 0.02 + 19 * 0.04) / 200)
    with pytest.raises(ValueError, match="in common"):
        one.gain_over(errors(np.full(3, 0.1), first=50))


def test_what_grows_along_a_clip_is_no_chance() -> None:
    """Twice as far from rest, twice the gain: from 0 to 1 dB, with a tenth of a dB of noise a picture."""
    rng = np.random.default_rng(0)
    grows = 10 ** (-0.1 * (np.linspace(0, 1, 40) + rng.normal(0, 0.1, 40)))
    gain = errors(0.01 * grows).gain_over(errors(np.full(40, 0.01)))
    assert gain.side() == 1 and gain.mean == pytest.approx(0.5, abs=0.05)
    noise = 10 ** (-0.1 * rng.normal(0, 1.0, (200, 40)))
    sides = [errors(0.01 * one).gain_over(errors(np.full(40, 0.01))).side() for one in noise]
    assert np.mean(np.array(sides) == 0) >= 0.9  # nineteen of twenty are to hold
