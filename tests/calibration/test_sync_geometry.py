"""Geometry against clocks: pictures with known shifts, the example's clips, and real ones from opposite sides."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from tests.conftest import EXAMPLE

from devrf.calibration.clocks.epipolar_motion import TimedPictures, accepted, clip_flow, epipolar_motion_delay
from devrf.calibration.clocks.epipolar_tracks import TrackFinder, essential, sampson, track_delay
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.geometry import GeometryCheck, PairCheck, check_clocks, refined
from devrf.calibration.formats import find_calibration
from devrf.capture.camera import Camera
from devrf.capture.video.reader import VideoReader


def poster(direction: str, offset_s: float, baseline_m: float, seed: int = 0) -> TimedPictures:
    """A poster 2 m away swings sideways or up and down before a still wall; a camera `baseline_m` to the right."""
    rng = np.random.default_rng(3)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (90, 110)).astype(np.float32), (0, 0), 1.2)
    picture = cv2.normalize(picture, np.zeros_like(picture), 20, 235, cv2.NORM_MINMAX)
    wall = np.full((180, 240), 128.0, np.float32)
    focal, depth_m = 200.0, 2.0
    times = np.arange(40) / 25.0
    noise = np.random.default_rng(seed)
    grey = []
    for time_s in times + offset_s:
        swing = 15 * np.sin(4.0 * time_s) + 6 * np.sin(9.1 * time_s + 1)
        x, y = (swing, 0.0) if direction == "sideways" else (0.0, swing)
        shift = np.array([[1, 0, 65 + x - focal * baseline_m / depth_m], [0, 1, 45 + y]])
        size = (240, 180)
        front = cv2.warpAffine(picture, shift, size, flags=cv2.INTER_LINEAR, borderValue=-1)
        shown = np.where(front < 0, wall, front) + noise.normal(0, 1, wall.shape)
        grey.append(np.clip(shown, 0, 255).astype(np.uint8))
    K = np.array([[focal, 0, 120], [0, focal, 90], [0, 0, 1.0]])
    pose = np.column_stack([np.eye(3), [-baseline_m, 0, 0]])
    return TimedPictures(Camera(240, 180, K, pose), np.stack(grey), times)


def test_motion_across_epipolar_lines_shows_the_delay():
    """Tracks are good to 0.1 px; the poster moves up to 4 px a frame: a fortieth of a frame, 1 ms; 3 for doubt."""
    a, b = poster("up and down", 0.0, 0.0), poster("up and down", 0.0312, 0.3, seed=1)
    moments = [(t, t) for t in np.linspace(0.3, 1.2, 8)]
    found = track_delay(TrackFinder(a), TrackFinder(b), moments, 0.0, 0.12)
    assert found is not None and found.matches >= 30
    assert abs(found.delay_s - 0.0312) < min(3e-3, 3 * found.std_s)
    assert found.error_px.min() < 0.5 * found.error_px.max()
    whole = epipolar_motion_delay(clip_flow(a), clip_flow(b))
    assert whole is not None and accepted(whole) and abs(whole.delay_s - 0.0312) < 0.02  # half a frame


@pytest.mark.full
def test_motion_along_epipolar_lines_shows_nothing():
    """The cameras stand side by side and the poster swings sideways: any delay fits."""
    views = {"cam0": poster("sideways", 0.0, 0.0), "cam1": poster("sideways", 0.0312, 0.3, seed=1)}
    clocks = {n: Clock(0.0, 0.0, s, "motion", 0.6, "") for n, s in (("cam0", 0.0), ("cam1", 0.02))}
    check = check_clocks(views, clocks)
    assert not any(c.sharp for c in check.corrections.values())
    assert any(n.startswith("cam0 and cam1: not observable") for n in check.notes)
    assert refined(clocks, check) == clocks


def example_view(name: str, shift_s: float = 0.0) -> TimedPictures:
    truth = json.loads((EXAMPLE / "ground_truth.json").read_text())["cams"][name]
    K = np.array(truth["K"])
    K[:2, 2] += 0.5
    pose = np.linalg.inv(np.array(truth["pose"]))[:3]
    with VideoReader(EXAMPLE / f"{name}.mp4") as reader:
        frames = list(reader)
    rows, columns = frames[0].rgb.shape[:2]
    camera = Camera(columns, rows, K, pose, np.array([truth["k1"], 0, 0, 0, 0]))
    grey = np.stack([cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in frames])
    file_s = np.array([f.time_s for f in frames])
    return TimedPictures(camera, grey, truth["offset_s"] + shift_s + (1 + 1e-6 * truth["drift_ppm"]) * file_s)


@pytest.mark.full
def test_right_clocks_pass_and_a_late_one_is_found_and_replaced():
    """cam2 is stated 40 ms late. Its truth is found within the goal of 3 ms, and three standard deviations."""
    views = {
        "cam1": example_view("cam1"),
        "witness": example_view("witness"),
        "cam2": example_view("cam2", 0.04),
    }
    clocks = {
        "cam1": Clock(0.0, 0.0, 0.0, "reference", 1.0, ""),
        "witness": Clock(0.0, 0.0, 1e-3, "audio", 0.8, ""),
        "cam2": Clock(0.5, 0.0, 0.03, "motion", 0.55, ""),
    }
    check = check_clocks(views, clocks)
    assert [p.by for p in check.pairs] == ["tracks"] * 3
    right, late = check.corrections["witness"], check.corrections["cam2"]
    assert right.sharp and not right.shifted and late.sharp and late.shifted
    assert abs(late.offset_s + 0.04) < min(3e-3, 3 * late.std_s)
    assert len(check.loops) == 1 and abs(check.loops[0].closure_s) < 0.25 / 16  # a quarter of a frame
    used = refined(clocks, check)
    assert used["witness"] == clocks["witness"]  # sound is kept; geometry only checks it
    assert used["cam2"].method == "geometry" and used["cam2"].offset_s == pytest.approx(0.46, abs=3e-3)


@pytest.mark.full
@pytest.mark.parametrize(("late", "pairs"), [(None, 2), ("cam2", 6)])
def test_a_camera_whose_sound_is_200_ms_off_is_found_where_sound_seems_sure(late: str | None, pairs: int):
    names = ("cam0", "cam1", "cam2", "cam3")
    views = {name: example_view(name, 0.2 if name == late else 0.0) for name in names}
    clocks = {name: Clock(0.0, 0.0, 1e-4, "audio", 0.95, "") for name in names}
    clocks["cam0"] = Clock(0.0, 0.0, 0.0, "reference", 1.0, "")
    check = check_clocks(views, clocks, loop_s=1e-4)
    assert len(check.pairs) == pairs
    assert {n for n, c in check.corrections.items() if c.shifted} == ({late} if late else set())
    if late:
        assert check.corrections[late].offset_s == pytest.approx(-0.2, abs=0.01)


@pytest.mark.full
@pytest.mark.parametrize("stride", [1, 2])
def test_real_views_from_opposite_sides_within_half_a_frame(data_dir, stride):
    """Hardware-synchronised cameras 148 degrees apart, a man moves: copies that begin at other frames."""
    capture = data_dir / "pose2sim_single"
    found = find_calibration(capture / "calibration" / "Calib.qca.txt").cameras
    flows, starts = [], {"cam02": 0, "cam04": 5 * stride - 2}
    for name, start in starts.items():
        grey, time_s = [], []
        with VideoReader(capture / "videos" / f"{name}.mp4") as reader:
            for frame in reader:
                if frame.index >= start and (frame.index - start) % stride == 0:
                    small = cv2.resize(frame.rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
                    grey.append(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
                    time_s.append(frame.time_s - start / 60)
        c = found[name]
        assert c.cam_from_world is not None
        camera = Camera(reader.info.width, reader.info.height, c.K, c.cam_from_world, c.distortion)
        flows.append(clip_flow(TimedPictures(camera, np.stack(grey), np.array(time_s))))
    delay = epipolar_motion_delay(*flows)
    assert delay is not None and accepted(delay)
    assert abs(delay.delay_s - (starts["cam04"] - starts["cam02"]) / 60) < stride / 60 / 2


def test_the_sampson_error_of_a_point_seen_by_two_cameras_is_zero():
    a = poster("sideways", 0.0, 0.0).camera
    turn, _ = cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))
    b = Camera(240, 180, a.K, np.column_stack([turn, [0.4, -0.1, 0.2]]))
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (20, 3))
    x, y = (p @ c.cam_from_world[:, :3].T + c.cam_from_world[:, 3] for c, p in ((a, points), (b, points)))
    p, q = x[:, :2] / x[:, 2:], y[:, :2] / y[:, 2:]
    assert np.abs(sampson(essential(a, b), p, q)).max() < 1e-12
    moved = np.abs(sampson(essential(a, b), p, q + [0.0, 1e-3]))
    assert moved.max() < 1e-3 and moved.max() > 1e-4  # at most the distance moved


def given_pairs(
    monkeypatch: pytest.MonkeyPatch, found: Mapping[tuple[str, str], tuple[float, float]]
) -> Callable[..., GeometryCheck]:
    """A check of three cameras' clocks in which pairs are apart by so much, with such standard deviations, seconds."""

    class Pairs:
        def __init__(self, views):
            pass

        def step_s(self, *names):
            return 0.04

        def planes(self, a, b):
            if (a, b) not in found:
                return None
            apart_s, std_s = found[a, b]
            shifted = abs(apart_s) > max(0.01, 3 * std_s)
            return PairCheck(a, b, "planes", apart_s, std_s, std_s < 0.02, shifted, np.zeros(1), np.zeros(1))

        def wide_search(self, *asked):
            return None

        narrow_search = wide_search

    monkeypatch.setattr("devrf.calibration.clocks.geometry._Work", Pairs)
    names = ("cam0", "cam1", "cam2")
    camera = poster("sideways", 0.0, 0.0).camera
    names = sorted({n for pair in found for n in pair} | set(names))
    views = {n: TimedPictures(camera, np.zeros((2, 1, 1), np.uint8), np.array([0.0, 2.0])) for n in names}
    return lambda clocks, **more: check_clocks(views, clocks, **more)


def test_a_clock_that_is_not_known_is_corrected_beside_those_that_are(monkeypatch: pytest.MonkeyPatch):
    """Geometry knows badly how cam0 lies beside all others, and well how these lie beside one another."""
    found = {
        ("cam0", "cam1"): (-0.057, 0.032),
        ("cam0", "cam2"): (-0.057, 0.032),
        ("cam1", "cam2"): (0.001, 0.001),
    }
    check_of = given_pairs(monkeypatch, found)
    heard = Clock(0.2, 0.0, 1e-4, "audio", 0.9, "")
    clocks = {
        "cam0": replace(heard, offset_s=0.0, method="reference"),
        "cam1": replace(heard, confidence=0.4),
    }
    clocks["cam2"] = heard
    check = check_of(clocks)
    assert check.corrections["cam1"].offset_s == pytest.approx(-0.057, abs=0.002)
    used = refined(clocks, check)
    assert used["cam2"] == heard
    assert used["cam1"].method == "geometry" and used["cam1"].std_s < 0.002
    assert used["cam1"].offset_s == pytest.approx(0.2, abs=0.002)


def test_guesses_are_weighed_with_what_geometry_says_vaguely(monkeypatch: pytest.MonkeyPatch):
    """Two cameras are sharp beside each other; where both lie beside the first, guesses say better than geometry."""
    found = {("cam0", "cam1"): (-0.2, 0.3), ("cam0", "cam2"): (-0.26, 0.3), ("cam1", "cam2"): (-0.06, 0.002)}
    guess = Clock(0.1, 0.0, 0.03, "motion", 0.49, "")
    clocks = {"cam0": replace(guess, offset_s=0.0, std_s=0.0, method="reference", confidence=1.0)}
    clocks |= {"cam1": guess, "cam2": guess}
    used = refined(clocks, given_pairs(monkeypatch, found)(clocks))
    assert used["cam2"].offset_s - used["cam1"].offset_s == pytest.approx(-0.06, abs=0.001)
    between = (used["cam1"].offset_s + used["cam2"].offset_s) / 2
    assert abs(between - 0.1) < 0.06  # geometry alone: 0.23 earlier
    assert used["cam1"].std_s == pytest.approx(0.067, abs=0.002)  # two guesses of 100 ms, two pairs of 300
    assert used["cam1"].method == "geometry"


def test_a_camera_that_no_pair_reaches_keeps_its_guess(monkeypatch: pytest.MonkeyPatch):
    found = {("cam0", "cam1"): (0.01, 0.002)}
    guess = Clock(0.1, 0.0, 0.03, "motion", 0.49, "")
    clocks = {"cam0": replace(guess, offset_s=0.0, std_s=0.0, method="reference", confidence=1.0)}
    clocks |= {"cam1": guess, "cam2": guess}
    used = refined(clocks, given_pairs(monkeypatch, found)(clocks))
    assert used["cam2"] == guess and used["cam1"].offset_s == pytest.approx(0.11, abs=0.001)


PAIRS_OF_FOUR = [(f"cam{a}", f"cam{b}") for a in range(4) for b in range(a + 1, 4)]


@pytest.mark.parametrize(
    ("change", "pairs"),
    [
        ({}, 2),
        ({"loop_s": None}, 6),
        ({"loop_s": 0.002}, 6),
        ({"std_s": 0.002}, 6),
        ({"method": "motion"}, 6),
        ({"late": 0.2}, 6),
        ({"vague": True}, 6),
        ({"confidence": 0.49}, 6),  # a peak of sound that is not trusted
    ],
)
def test_where_sound_is_sure_each_camera_is_compared_with_one_other(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], pairs: int
):
    """All pairs are compared where something is not sure: sound, its contradictions, or what two pairs say."""
    late = change.get("late", 0.0)
    found = {(a, b): (late * (b == "cam3"), 0.1 if change.get("vague") else 0.001) for a, b in PAIRS_OF_FOUR}
    heard = Clock(
        0.2, 0.0, change.get("std_s", 1e-4), change.get("method", "audio"), change.get("confidence", 0.9), ""
    )
    clocks = dict.fromkeys(["cam1", "cam2", "cam3"], heard)
    clocks = {"cam0": Clock(0.0, 0.0, 0.0, "reference", 1.0, ""), **clocks}
    check = given_pairs(monkeypatch, found)(clocks, loop_s=change.get("loop_s", 1e-4))
    assert len(check.pairs) == pairs
    if pairs == 2:
        assert {n for p in check.pairs for n in (p.first, p.second)} == set(clocks)
        assert set(check.corrections) == {"cam1", "cam2", "cam3"} and not check.notes
    shifted = {n for n, c in check.corrections.items() if c.shifted}
    assert shifted == ({"cam3"} if late else set())
    if late:
        assert check.corrections["cam3"].offset_s == pytest.approx(late, abs=0.01)


def test_a_test_camera_with_sure_sound_is_compared_with_two_that_stand(monkeypatch: pytest.MonkeyPatch):
    found = {pair: (0.2 * (pair[1] == "cam3"), 0.001) for pair in PAIRS_OF_FOUR}
    heard = Clock(0.2, 0.0, 1e-4, "audio", 0.9, "")
    clocks = {"cam0": Clock(0.0, 0.0, 0.0, "reference", 1.0, "")}
    clocks |= dict.fromkeys(["cam1", "cam2", "cam3"], heard)
    known = ("cam0", "cam1", "cam3")
    check = given_pairs(monkeypatch, found)(clocks, known=known, loop_s=1e-4)
    assert {(p.first, p.second) for p in check.pairs} == {("cam0", "cam2"), ("cam1", "cam2")}
    late = given_pairs(monkeypatch, found)(clocks, known=("cam0", "cam1", "cam2"), loop_s=1e-4)
    assert len(late.pairs) == 3 and late.corrections["cam3"].shifted
