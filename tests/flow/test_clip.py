"""A clip's flow: direction, size, gaps and what it says about itself."""

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.system.errors import FlowError
from devrf.flow.checks import FlowChecks
from devrf.flow.clip import ClipPictures, clip_flow, gaps_of
from devrf.flow.dis import DisFlow
from devrf.flow.estimator import FlowEstimator
from devrf.flow.given import given
from devrf.flow.pair import Find, estimated
from devrf.flow.store import BEST, CameraFlow, pair_path, read_flows

STEP = (5.0, -2.0)  # motion of the square per frame: right and up


class Swapped:
    """A method that mixes up its two pictures."""

    name = "swapped"
    parallel = False

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


@pytest.fixture
def run(tmp_path):
    """`run(pictures)`: flow and checks of a clip, through the entry point and from disk."""

    def run(
        pictures,
        index=None,
        time=None,
        size=(160, 120),
        estimator: FlowEstimator | None = None,
        find: Find | None = None,
    ) -> tuple[CameraFlow, FlowChecks]:
        count = len(pictures)
        gap = gaps_of("cam0", np.arange(float(count)) if time is None else time)
        method = find or estimated(estimator or DisFlow())
        index = range(count) if index is None else index
        filmed = ClipPictures("cam0", index, gap, pictures.__getitem__)
        checks = clip_flow(filmed, size, method, tmp_path, workers=2)
        return read_flows(tmp_path)["cam0"], checks

    return run


def test_flow_is_backward_and_in_pixels_of_the_stored_size(clip, run):
    flow, checks = run(clip[:3], index=[3, 4, 6], size=(80, 40))
    assert flow.index.tolist() == [4, 6] and flow.flow.shape == (2, 40, 80, 2)
    inside = flow.flow[1, 15:26, 22:38].astype(np.float32).reshape(-1, 2)  # well inside the square, reduced
    # backward: the content came from the left and from below; x is halved, y is a third
    np.testing.assert_allclose(np.median(inside, axis=0), [-STEP[0] / 2, -STEP[1] / 3], atol=0.1)
    wall = flow.flow[:, :, 65:].astype(np.float32)[flow.valid[:, :, 65:]]
    assert np.abs(wall).mean() < 0.1
    assert checks.pairs == 2 and checks.gaps == 0


def test_checks_of_a_good_clip(clip, run):
    _, checks = run(clip)
    assert checks.valid is not None and checks.valid > 0.9 and checks.large == 0
    assert checks.moving == pytest.approx(60 * 60 / (120 * 160), rel=0.3)
    assert checks.warp_ratio is not None and checks.warp_ratio < 0.2
    assert checks.round_trip_px is not None and checks.round_trip_px < 0.2
    assert checks.unsure < 0.1 and checks.better_as is None
    assert checks.shake_px is not None and checks.shake_px < 0.1


def test_swapped_direction_is_named_by_warping(clip, run):
    _, checks = run(clip, estimator=Swapped())
    assert checks.warp_ratio is not None and checks.warp_ratio > 0.9
    assert checks.better_as == "forward"


@pytest.fixture
def uneven() -> list[np.ndarray]:
    """Pictures [120, 160, 3] that slide by another step each time."""
    rng = np.random.default_rng(1)
    wide = cv2.resize(rng.integers(20, 235, (24, 64, 3)).astype(np.uint8), (320, 120))
    return [wide[:, x : x + 160] for x in (0, 2, 8, 9, 16, 20, 30, 33)]


@pytest.mark.parametrize(
    ("shift", "scale", "named"), [(0, 1, None), (1, 1, "next"), (-1, 1, "before"), (0, 2, "full size")]
)
def test_given_flow_is_told_by_warping(uneven, run, shift, scale, named):
    places = [0, 2, 8, 9, 16, 20, 30, 33]
    size = (120 // scale, 160 // scale)

    def read(n: int) -> tuple[np.ndarray, np.ndarray]:
        k = min(max(n + shift, 1), len(places) - 1)
        flow = np.zeros((*size, 2), np.float32)
        flow[..., 0] = places[k] - places[k - 1]  # what is at x was right of it; not scaled with the size
        mask = np.zeros(size, bool)
        mask[:, : size[1] - 12] = True
        return flow, mask

    _, checks = run(uneven, find=given(read))
    assert checks.better_as == named


def test_nothing_valid_across_a_gap(clip, run):
    flow, checks = run(clip, time=[0.0, 0.1, 0.2, 0.41, 0.5, 0.6])
    assert checks.gaps == 1 and checks.pairs == 4
    assert flow.index[2] == 3 and not flow.valid[2].any() and not flow.flow[2].any()
    assert flow.valid[[0, 1, 3, 4]].any(axis=(1, 2)).all()


def test_nothing_moves_is_not_an_error(clip, run):
    _, checks = run([clip[0]] * 2)
    assert checks.moving == 0 and checks.warp_ratio is None and checks.valid == 1 == checks.supported


@pytest.mark.parametrize("time", [[0.0], [0.0, 0.0], [1.0, 0.5]])
def test_times_must_rise(time):
    with refused("times-not-rising", "cam0", kind=FlowError):
        gaps_of("cam0", time)


def test_size_change_is_named(clip, run):
    with refused(
        "picture-size-wrong", "cam0", "frames 8", "7", "[100, 160, 3]", "[120, 160, 3]", kind=FlowError
    ):
        run([clip[0], clip[1][:100]], index=[7, 8])


def test_16_bit_pictures_are_refused(clip, run):
    with refused("picture-kind-unread", "uint16", "8 bits", kind=FlowError):
        run([picture.astype(np.uint16) * 257 for picture in clip[:2]])


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (lambda flow: np.moveaxis(flow, -1, 0), ("float32", "[2, 120, 160]", "[120, 160, 2]")),
        (lambda flow: flow.astype(np.float64), ("float64",)),
        (lambda flow: None, ("NoneType", "[]")),
    ],
)
def test_a_method_that_gives_no_flow_is_named(clip, run, given, named):
    class Mine:
        name, parallel = "mine", False

        def estimate(self, image0, image1):
            return given(DisFlow().estimate(image0, image1))

    with refused("estimator-result-wrong", "cam0", "frames 1 and 0", "mine", *named, kind=FlowError):
        run(clip[:2], estimator=Mine())


def test_a_shaking_camera_is_told_from_a_moving_subject(clip, run):
    shaken = []
    for n, picture in enumerate(clip):
        matrix = np.array([[1, 0, 0.4 * (n % 2)], [0, 1, 0]], np.float64)
        shaken.append(cv2.warpAffine(picture, matrix, (160, 120), borderMode=cv2.BORDER_REPLICATE))
    _, checks = run(shaken)
    assert checks.shake_px == pytest.approx(0.4, abs=0.1)  # DIS is good to 0.1 px on such pictures


@pytest.mark.parametrize(("step", "large"), [(24, 1), (16, 0)])
def test_moves_beyond_an_eighth_of_the_width_are_counted(uneven, run, step, large):
    """Of 160 pixels, 20 are an eighth."""

    def read(n: int) -> tuple[np.ndarray, np.ndarray]:
        flow = np.zeros((120, 160, 2), np.float32)
        flow[..., 0] = step
        return flow, np.ones((120, 160), bool)

    wide = np.concatenate([uneven[0], uneven[0][:, ::-1]], axis=1)
    _, checks = run([wide[:, n * step : n * step + 160] for n in range(3)], find=given(read))
    assert checks.large == large and checks.moving_valid == 1


def test_what_does_not_come_back_is_rejected(clip, run):
    """48 columns move by 6 px; the way back is known of those that came from left of column 96."""

    class Hidden:
        name, parallel = "hidden", False

        def estimate(self, image0, image1):
            flow = np.zeros((120, 160, 2), np.float32)
            if np.array_equal(image0, clip[1]):
                flow[:, 80:128, 0] = -6
            else:
                flow[:, 64:96, 0] = 6
            return flow

    _, checks = run(clip[:2], estimator=Hidden())
    # |f + b| is 0 or 6; the rule allows 0.5 * 6 + 0.5 where the way back is 0, and 6.5 where both are 6
    assert checks.moving == pytest.approx(48 / 160)
    assert checks.moving_valid == pytest.approx((96 + 6 - 80) / 48)


def test_plain_cloth_is_not_sure_of_its_flow(run):
    rng = np.random.default_rng(2)
    wall = cv2.resize(rng.integers(20, 235, (24, 32, 3)).astype(np.uint8), (160, 120))
    ripples = cv2.resize(rng.integers(118, 122, (5, 5, 3)).astype(np.uint8), (90, 90))
    pictures = []
    for n in range(4):
        picture = wall.copy()
        picture[15:105, 10 + 4 * n : 100 + 4 * n] = ripples
        pictures.append(np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8))
    flow, checks = run(pictures)
    assert checks.unsure > 0.4
    assert flow.confidence is not None
    # inside the cloth, away from its edges, next to inside the wall
    assert np.median(flow.confidence[:, 40:80, 45:80]) < 0.5 * np.median(flow.confidence[:, :, 135:])
    assert np.median(flow.confidence[:, :, 135:]) >= 0.7 * BEST


def test_a_stopped_clip_finds_only_what_is_missing(clip, tmp_path):
    asked: list[int] = []

    def find(n, current, previous):
        asked.append(n)
        return estimated(DisFlow())(n, current, previous)

    def make() -> FlowChecks:
        gap = np.zeros(5, bool)
        return clip_flow(ClipPictures("cam0", range(6), gap, clip.__getitem__), (160, 120), find, tmp_path)

    first = make()
    whole = {n: pair_path(tmp_path, "cam0", n).read_bytes() for n in range(1, 6)}
    pair_path(tmp_path, "cam0", 2).unlink()
    pair_path(tmp_path, "cam0", 4).write_bytes(whole[4][:100])  # cut off
    asked.clear()
    assert make() == first
    assert asked == [2, 4]
    assert {n: pair_path(tmp_path, "cam0", n).read_bytes() for n in range(1, 6)} == whole


def test_many_threads_find_the_same(clip, tmp_path):
    out = {}
    for workers in (1, 4):
        folder = tmp_path / str(workers)
        gap = np.zeros(5, bool)
        find = estimated(DisFlow())
        filmed = ClipPictures("cam0", range(6), gap, clip.__getitem__)
        clip_flow(filmed, (160, 120), find, folder, workers)
        out[workers] = [pair_path(folder, "cam0", n).read_bytes() for n in range(1, 6)]
    assert out[1] == out[4]
