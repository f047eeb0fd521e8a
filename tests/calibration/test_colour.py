"""Colours of cameras: points that two of them share, the simplest correction; on pictures of known colours."""

import math

import cv2
import numpy as np
import pytest
from tests.calibration import coloured_room as room
from tests.refused import refused

from devrf.calibration.colour import match
from devrf.calibration.colour.camera_points import camera_pairs
from devrf.calibration.colour.colours import CameraColour, Colours, read_colours
from devrf.calibration.colour.correction_fit import brighter_by, difference, fit_correction, folds
from devrf.calibration.colour.match import Apart, match_cameras
from devrf.calibration.colour.surface import WHITE_LEVEL, Pairs, View
from devrf.calibration.colour.sweep_points import SweepPoints, sweep_pairs
from devrf.capture.colour.correction import SAME, Look, as_matrix
from devrf.capture.colour.srgb import LINEAR_OF_LEVEL
from devrf.capture.frames import SWEEP
from devrf.capture.system.errors import CaptureError

MIXED = np.array([[0.9, 0.06, -0.02], [0.03, 0.8, 0.05], [0.0, -0.04, 1.1]])
LOOKS = [
    ("none", np.eye(3)),
    ("gain", 0.7 * np.eye(3)),
    ("diagonal", np.diag([1.2, 0.8, 0.6])),
    ("matrix", MIXED),
]
NOISE = 0.03  # of a patch's light, relative: 8-bit pictures resampled, with noise
ALIKE = 1  # drawn pairs are independent


def drawn_pairs(
    colours: np.ndarray, n: int = 400, seed: int = 0, strange: float = 0.1, spread: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light of points in a camera and in the reference, and where; some are other things altogether.

    Args:
        colours: Light of the camera = colours · light of the reference.
        n: Points.
        seed: Of everything.
        strange: Share of points that are not the same thing.
        spread: Of hues: 0 is a grey world.
    """
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.05, 0.5, (n, 1))
    light = grey + spread * (rng.uniform(0.05, 0.5, (n, 3)) - grey)
    own, wanted = (v * (1 + NOISE * rng.standard_normal(v.shape)) for v in (light @ colours.T, light))
    other = rng.random(n) < strange
    own[other] = rng.uniform(0.02, 0.6, (int(other.sum()), 3))
    return own, wanted, rng.random((n, 2))


# --- the simplest correction ---


@pytest.mark.parametrize(("kind", "colours"), LOOKS)
@pytest.mark.parametrize("seed", range(4))
def test_the_correction_that_was_put_in_is_found(kind, colours, seed):
    own, wanted, place = drawn_pairs(colours, seed=seed)
    found = fit_correction(own, wanted, place, ALIKE)
    assert found.kind == kind
    # both sides' noise, 0.03 √2 of the light, over 360 good points: 0.0022 for a gain of one channel. A matrix also
    # tells channels apart, which differ by a factor of about 2 (0.7 in logarithm): 1 / 0.7 more. Cauchy's loss keeps
    # 0.9 of what is to be known; 4 standard deviations. The prior is worth as much as (noise / 0.1)² points: none.
    allowed = 4 * NOISE * math.sqrt(2 / 360) / 0.9 * (1.7 if kind == "matrix" else 1.0)
    assert np.abs(found.matrix @ colours - np.eye(3)).max() < allowed


def test_a_camera_of_equal_look_gets_none():
    for seed in range(8):
        assert fit_correction(*drawn_pairs(np.eye(3), seed=seed), ALIKE).kind == "none"


def test_a_grey_world_supports_no_matrix():
    """Greys say nothing of how channels mix: three gains are all there is to find."""
    own, wanted, place = drawn_pairs(np.diag([1.2, 0.8, 0.6]) @ MIXED, strange=0, spread=0)
    assert fit_correction(own, wanted, place, ALIKE).kind == "diagonal"


def test_points_that_say_the_same_support_less():
    """Twelve points of one patch of wall are one: no nine unknowns from a hundred of them."""
    own, wanted, place = drawn_pairs(MIXED, n=100, strange=0)
    assert fit_correction(own, wanted, place, alike=1).kind == "matrix"
    assert fit_correction(own, wanted, place, alike=10).kind != "matrix"


def test_neighbours_are_held_back_together():
    rng = np.random.default_rng(0)
    place = rng.random((200, 2))
    near = np.floor(16 * place) / 16 + rng.random((200, 2)) / 16.001  # in the same tile
    np.testing.assert_array_equal(folds(place, 4), folds(near, 4))
    assert np.bincount(folds(place, 4)).min() > 20


@pytest.mark.parametrize("level", [0.5, 0.02])
def test_brightness_in_stops(level):
    rng = np.random.default_rng(0)
    light = level * rng.uniform(0.5, 1, (400, 3))
    own = 0.5 * light * (1 + NOISE * rng.standard_normal(light.shape))
    stops, std = brighter_by(own, light, alike=1)
    expected = NOISE / math.log(2) * math.sqrt(math.pi / 2 / 400)  # of a median
    assert std == pytest.approx(expected, rel=0.3)
    assert abs(stops + 1) < 4 * expected


def test_the_difference_is_rms_of_srgb():
    # sRGB 0, 0.5, 1 and 0, 1, 1 (clipped)
    a, b = (np.array([[0.0, 0.214041, 1.0]]), np.array([[0.0, 1.0, 2.0]]))
    np.testing.assert_allclose(difference(a, b), [math.sqrt(0.25 / 3)], rtol=1e-4)


# --- all cameras ---


def pairs_of(first: str, second: str, looks: dict[str, np.ndarray], n: int = 300, seed: int = 0) -> Pairs:
    """Pairs whose light in each camera is looks[camera] · light."""
    rng = np.random.default_rng(seed)
    light = rng.uniform(0.05, 0.5, (n, 3))
    both = [
        light @ looks[name].T * (1 + NOISE * rng.standard_normal(light.shape)) for name in (first, second)
    ]
    return Pairs(first, second, np.stack(both, axis=1), rng.random((n, 2)), alike=1)


LOOKS_OF = {"a": np.eye(3), "b": 0.7 * np.eye(3), "c": np.diag([1.3, 1.0, 0.7]), "d": 1.4 * np.eye(3)}


def test_a_camera_is_reached_over_others():
    pairs = [pairs_of("c", "b", LOOKS_OF, seed=1), pairs_of("a", "b", LOOKS_OF, n=200, seed=2)]
    found = match_cameras(pairs, "a")
    assert {name: c.kind for name, c in found.corrections.items()} == {"b": "gain", "c": "diagonal"}
    for name, correction in found.corrections.items():
        # of b: 150 points of three channels; c stands on b as well. 4 standard deviations
        allowed = 4 * NOISE * math.sqrt(2 / 150 + 2 / 225)
        assert np.abs(correction.matrix @ LOOKS_OF[name] - np.eye(3)).max() < allowed
    assert found.total.before is not None and found.total.after is not None
    assert found.total.after < found.total.before / 3
    assert found.total.points == sum(int((folds(p.place[:, ::-1], 4) == 0).sum()) for p in pairs)


def test_cameras_without_common_points_are_left_out():
    found = match_cameras([pairs_of("a", "b", LOOKS_OF), pairs_of("c", "d", LOOKS_OF)], "a")
    assert set(found.corrections) == {"b"} and found.fitted.keys() == {"b"}


def test_a_point_or_two_say_nothing():
    few = pairs_of("a", "b", LOOKS_OF, n=8)
    found = match_cameras([Pairs("a", "b", few.colours, few.place, alike=10)], "a")
    assert found.corrections == {} and found.brightness == {}


def test_points_held_out_are_never_fitted():
    whole = pairs_of("a", "c", LOOKS_OF)
    held = match._held(whole)
    colours = whole.colours.copy()
    colours[held] = np.random.default_rng(5).uniform(0, 1, colours[held].shape)
    a, b = (match_cameras([Pairs("a", "c", c, whole.place, alike=1)], "a") for c in (whole.colours, colours))
    np.testing.assert_array_equal(a.corrections["c"].matrix, b.corrections["c"].matrix)
    assert a.brightness == b.brightness
    assert b.total.after is not None and a.total.after is not None and b.total.after > 3 * a.total.after
    assert a.fitted["c"] + a.total.points == 300


def test_a_test_camera_is_measured_and_changes_nothing():
    train = [pairs_of("a", "b", LOOKS_OF, seed=1)]
    all_of_them = [*train, pairs_of("a", "d", LOOKS_OF, seed=2), pairs_of("b", "d", LOOKS_OF, seed=3)]
    found, without = match_cameras(all_of_them, "a", measured={"d"}), match_cameras(train, "a")
    assert set(found.corrections) == {"b"} and found.total == without.total
    np.testing.assert_array_equal(found.corrections["b"].matrix, without.corrections["b"].matrix)
    # against a and against b as it is corrected: 450 points, 1.2533 for a median; 4 standard deviations
    allowed = 4 * 1.2533 * NOISE * math.sqrt(2 / 450) / math.log(2)
    assert abs(found.brightness["d"][0] - math.log2(1.4)) < allowed
    # b is corrected, d is not
    assert found.apart["d"].before == pytest.approx(found.apart["d"].after, rel=0.8)


# --- points that the sweep and a camera see ---


@pytest.fixture(scope="module")
def swept():
    """A sweep of the room and its pictures."""
    model = room.sweep()
    views = zip(model.names, model.cameras, strict=True)
    return model, {name: room.show(camera, seed=n).rgb for n, (name, camera) in enumerate(views)}


def with_sweep(swept, view: View) -> Pairs:
    model, pictures = swept
    return sweep_pairs("cam0", view, SweepPoints(model, 1.0, pictures.__getitem__))


@pytest.mark.parametrize(("kind", "colours"), LOOKS)
def test_a_camera_against_the_sweep(swept, kind, colours):
    pairs = with_sweep(swept, room.show(room.camera(0.7, -1.2), colours, seed=99))
    assert len(pairs.colours) > 200  # of 500 points, most of which both see
    found = match_cameras([pairs], SWEEP)
    assert found.corrections["cam0"].kind == kind
    # The true correction, on the same points: nine unknowns from 600 values add 1.5 % to squares; four times that
    held = pairs.colours[match._held(pairs)]
    oracle = math.sqrt(np.square(difference(held[:, 0], held[:, 1] @ np.linalg.inv(colours).T)).mean())
    after = found.apart["cam0"].after
    assert after is not None and after <= oracle * math.sqrt(1.06)
    # a level of noise, 0.01, a mean of 81 samples that share pixels, and resampling of two pictures
    assert oracle < 0.01


def test_a_sweep_of_another_unit(swept):
    """The rig is in metres, the sweep in units of 0.25 m."""
    model, pictures = swept
    view = room.show(room.camera(0.7), seed=99)
    moved = View(view.camera.moved(np.diag([4.0, 4, 4, 1])), view.rgb)
    pairs = sweep_pairs("cam0", moved, SweepPoints(model, 4.0, pictures.__getitem__))
    assert len(pairs.colours) == len(with_sweep(swept, view).colours)


def test_clipped_points_are_left_out(swept):
    """A third of the room is at white in the sweep, and not in the camera, which is darker."""
    model, _ = swept
    bright = {
        n: room.show(c, seed=i, brightest=1.2).rgb
        for i, (n, c) in enumerate(zip(model.names, model.cameras, strict=True))
    }
    view = room.show(room.camera(0.7), 0.6 * np.eye(3), seed=99, brightest=1.2)
    pairs = sweep_pairs("cam0", view, SweepPoints(model, 1.0, bright.__getitem__))
    assert (bright[model.names[4]] >= WHITE_LEVEL).any(axis=2).mean() > 0.2
    assert 30 < len(pairs.colours) < 150  # 320 with the clipped ones
    assert pairs.colours.max() < LINEAR_OF_LEVEL[WHITE_LEVEL]
    correction = match_cameras([pairs], SWEEP).corrections["cam0"]
    # 0.03 of the light, 40 points of three channels: 0.0027; 3 standard deviations. With the clipped ones: 0.0105
    assert correction.kind == "gain" and abs(correction.matrix[0, 0] * 0.6 - 1) < 3 * 0.0027


def test_points_behind_something_are_left_out(swept):
    """A person stands before two fifths of the picture: nothing of it becomes a pair."""
    view = room.show(room.camera(0.7, -1.2), seed=99)
    rng = np.random.default_rng(1)
    person = cv2.resize(rng.integers(10, 90, (45, 24, 3)).astype(np.uint8), (192, 360))
    hidden = view.rgb.copy()
    hidden[:, 100:292] = person
    pairs = with_sweep(swept, View(view.camera, hidden))
    x = pairs.place[:, 0] * view.camera.width
    # the person's texture correlates by chance with a few; they do not change what is found
    assert ((x > 105) & (x < 287)).mean() < 0.03 and len(pairs.colours) > 100
    assert match_cameras([pairs], SWEEP).corrections["cam0"].kind == "none"


def test_a_camera_that_sees_none_of_the_points(swept):
    camera = room.camera(0.7)
    turned = np.diag([-1.0, 1.0, -1.0]) @ camera.cam_from_world
    away = View(type(camera)(camera.width, camera.height, camera.K, turned), swept[1]["static/000000.png"])
    pairs = with_sweep(swept, away)
    assert pairs.colours.shape == (0, 2, 3)
    assert match_cameras([pairs], SWEEP).corrections == {}


# --- points that fixed cameras see ---


@pytest.mark.full
def test_cameras_against_each_other():
    looks = {"cam0": np.eye(3), "cam1": 0.6 * np.eye(3), "cam2": np.diag([1.25, 1.0, 0.7])}
    stands = {"cam0": room.camera(0.55), "cam1": room.camera(0.75, -1.3), "cam2": room.camera(0.95, -1.7)}
    moments = [
        {name: room.show(stands[name], looks[name], seed=10 * t + n) for n, name in enumerate(looks)}
        for t in range(2)
    ]
    pairs = camera_pairs(moments)
    assert [(p.first, p.second) for p in pairs] == [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")]
    found = match_cameras(pairs, "cam0")
    assert {name: c.kind for name, c in found.corrections.items()} == {"cam1": "gain", "cam2": "diagonal"}
    for name, correction in found.corrections.items():
        # 0.03 of the light, and as many points as were fitted, ten of which say as much as one; 4 deviations
        allowed = 4 * NOISE * math.sqrt(2 * pairs[0].alike / found.fitted[name])
        assert np.abs(correction.matrix @ looks[name] - np.eye(3)).max() < allowed
    assert found.total.before is not None and found.total.after is not None
    assert found.total.after < found.total.before / 3


def test_cameras_that_show_other_rooms_share_nothing():
    seen = room.show(room.camera(0.6))
    noise = np.random.default_rng(3).integers(0, 255, (36, 48, 3)).astype(np.uint8)
    other = View(room.camera(0.9), cv2.resize(noise, room.SIZE, interpolation=cv2.INTER_CUBIC))
    (pairs,) = camera_pairs([{"cam0": seen, "cam1": other}])
    assert len(pairs.colours) < 12  # fewer than one gain needs
    assert match_cameras([pairs], "cam0").corrections == {}


# --- on disk ---


def test_colours_come_back_from_disk(tmp_path):
    gains = np.column_stack([[0, 10, 20], np.array([[1.0, 1, 1], [1.1, 1, 1], [1.2, 1, 1]])])
    np.save(tmp_path / "gains_cam0.npy", gains)
    matched = CameraColour(
        "points",
        "matrix",
        as_matrix(MIXED),
        0.2,
        0.01,
        300,
        Apart(90, 0.1, 0.02),
        gains="gains_cam0.npy",
    )
    colours = Colours(
        tmp_path, SWEEP, {SWEEP: CameraColour("reference"), "cam0": matched}, Apart(90, 0.1, 0.02)
    )
    colours.write()
    again = read_colours(tmp_path)
    assert again == colours
    assert again.look(SWEEP, 0) is None and again.look("unknown", 0) is None
    assert again.look("cam0", 12) == Look(as_matrix(MIXED), (1.1, 1.0, 1.0))
    assert again.before_matching("cam0", 19) == Look(SAME, (1.2, 1.0, 1.0))


def test_a_damaged_file_says_what_to_do(tmp_path):
    (tmp_path / "colour.json").write_text('{"reference": null}')
    with refused("file-damaged", "colour.json", "--from colour", kind=CaptureError):
        read_colours(tmp_path)
