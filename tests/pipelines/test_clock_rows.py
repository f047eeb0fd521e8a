"""What goes wrong with clocks (numbers of the list of failure cases, D1 to D25): the row that fires, its remedy."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import fftconvolve
from tests.judged import judged

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.equations import Clock, Cue, Loop
from devrf.calibration.clocks.flash import Brightness
from devrf.calibration.clocks.geometry import ClockCorrection, GeometryCheck, refined
from devrf.calibration.clocks.sync import SyncResult, synchronise
from devrf.capture.camera import Camera
from devrf.capture.frames import CameraFrames, FrameRecord
from devrf.capture.photos.picture_files import write_png
from devrf.capture.system.progress import no_progress
from devrf.capture.video.audio import Sound
from devrf.capture.video.recorded import Recorded, timecode_s
from devrf.lab.simulate.session.flash import RollingShutter, exposed
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.stages.scene.clock_check import (
    MIN_FRAMES,
    check_measures,
    clock_check,
    timed_pictures,
    unknown_clocks,
    untimed,
)
from devrf.pipelines.stages.sync import measures

RATE_HZ, FPS = 48_000, 30.0
NAMES = ("cam0", "cam1", "cam2")
OFFSETS_S = {"cam0": 0.0, "cam1": 0.21, "cam2": -0.13}
CLAPS_S = (0.9, 1.7, 2.2, 3.6)


def camera(seconds: float = 5.0, fps: float = FPS, **more: Any) -> CameraFrames:
    records = tuple(FrameRecord(i, i / fps, 10.0, True, f"{i}.png") for i in range(int(seconds * fps)))
    values: dict[str, Any] = {
        "role": "camera", "source": "clip.mp4", "width": 64, "height": 48, "fps_mean": fps,
        "variable_rate": False, "has_audio": True, "exif_focal_px": None, "rotation_deg": 0, "frames": records,
    }  # fmt: skip
    return CameraFrames(**{**values, **more})


CAMERAS = {name: camera() for name in NAMES}
SPANS = {name: (0.0, 5.0 - 1 / FPS) for name in NAMES}


def heard(offset_s: float, claps_s=CLAPS_S, drift_ppm: float = 0.0, seconds: float = 5.0, lag_s=0.0) -> Sound:
    """Claps as a clock with this offset and drift records them, with noise of its own; `lag_s` late in the file."""
    samples = 0.003 * np.random.default_rng(int(1e3 * (offset_s + 5))).normal(size=int(seconds * RATE_HZ))
    burst = np.random.default_rng(0).normal(size=1000) * np.exp(-np.arange(1000) / 150)
    for clap_s in claps_s:
        at = round(((clap_s - offset_s) / (1 + 1e-6 * drift_ppm) + lag_s) * RATE_HZ)
        if 0 <= at < len(samples) - 1000:
            samples[at : at + 1000] += 0.3 * burst
    return Sound(samples.astype(np.float32), RATE_HZ, 0.0)


def lit(offset_s: float, flashes_s=(0.83, 1.47, 2.9), seed: int = 0) -> Brightness:
    shutter, bands, n = RollingShutter(offset_s), (np.arange(24) + 0.5) / 24, np.arange(150)
    light = np.stack([exposed(shutter, int(k), bands, flashes_s) for k in n])
    return Brightness(n / FPS, 90 + 60 * light + np.random.default_rng(seed).normal(0, 0.2, light.shape))


def moved(offset_s: float, seed: int = 0) -> np.ndarray:
    """Motion energy of uneven gestures."""
    gestures = np.random.default_rng(7)
    at, size = gestures.uniform(0, 5, 8), gestures.uniform(0.4, 1.5, 8)
    file_s = np.arange(149) / FPS + 0.5 / FPS
    course = (size * np.exp(-(((file_s[:, None] + offset_s - at) / 0.15) ** 2))).sum(1)
    noise = np.abs(np.random.default_rng(seed).normal(size=149))
    return np.stack([file_s, course + 0.05 + 0.03 * noise], 1)


SOUNDS = {name: heard(offset_s) for name, offset_s in OFFSETS_S.items()}
MOTION = {name: moved(offset_s, i) for i, (name, offset_s) in enumerate(OFFSETS_S.items())}
LIGHT = {name: lit(offset_s, seed=i) for i, (name, offset_s) in enumerate(OFFSETS_S.items())}


def rows_of(result: SyncResult, cameras: dict[str, CameraFrames] = CAMERAS) -> dict[str, HealthRow]:
    return judged(measures({n: cameras[n] for n in result.cameras}, result))


def notes_of(result: SyncResult) -> str:
    return "; ".join(result.notes)


def test_a_healthy_capture_fires_none():
    recorded = {n: Recorded(1.7e9 + o, 36_000 + o, FPS) for n, o in OFFSETS_S.items()}
    result = synchronise(SPANS, SOUNDS, MOTION, extras=Extras(LIGHT, recorded))
    rows = rows_of(result)
    assert {row.verdict for row in rows.values()} == {"ok"}, rows
    assert {"flash", "motion"} <= {c.other for c in result.comparisons}
    for name, offset_s in OFFSETS_S.items():
        assert result.cameras[name].offset_s == pytest.approx(offset_s, abs=2e-4)
    assert len(result.loops) == 2 and max(abs(loop.closure_s) for loop in result.loops) < 5e-3


def test_d1_d19_no_sound_and_nothing_moves():
    still = {n: np.stack([np.arange(149) / FPS, np.ones(149)], 1) for n in NAMES}
    result = synchronise(SPANS, {n: SOUNDS[n] for n in NAMES[:2]}, still)
    row = rows_of(result)["clock-unknown cam2"]  # the others are enough to go on without it
    assert row.verdict == "warn" and "cam2: no sound" in row.remedy and "capture.timestamps" in row.remedy
    assert "cam0 and cam2: too little motion" in notes_of(result)
    assert untimed(result.cameras, CAMERAS) == ["cam2"]
    two = {n: result.cameras[n] for n in ("cam0", "cam2")}
    assert untimed(two, CAMERAS) == [] and judge(unknown_clocks(two, "", CAMERAS))[0].verdict == "fail"


def test_d2_a_weak_peak():
    rng = np.random.default_rng(3)
    noise = {n: Sound(0.1 * rng.normal(size=5 * RATE_HZ).astype(np.float32), RATE_HZ, 0.0) for n in NAMES[:2]}
    result = synchronise({n: SPANS[n] for n in noise}, noise, {})
    row = rows_of(result)["clock-unknown cam1"]
    assert row.verdict == "fail" and re.search(r"sound .* peak is 1\.\d", row.remedy)


def test_d3_a_beat_is_ambiguous_and_a_timecode_settles_it():
    beat = tuple(np.arange(0.1, 6.0, 0.5))
    sounds = {n: heard(OFFSETS_S[n], beat) for n in NAMES[:2]}
    spans = {n: SPANS[n] for n in sounds}
    alone = synchronise(spans, sounds, {})
    assert rows_of(alone)["clock-unknown cam1"].verdict == "fail"
    assert "every 0.50 s" in notes_of(alone)
    stated = {"cam0": Recorded(None, 36_000.0, FPS), "cam1": Recorded(None, 36_000.0 + 6 / FPS, FPS)}
    settled = synchronise(spans, sounds, {}, extras=Extras(recorded=stated))
    assert settled.cameras["cam1"].offset_s == pytest.approx(0.21, abs=2e-4)
    assert "timecode" in notes_of(settled)


def test_d4_a_room_that_rings():
    """A resonance at 700 Hz that builds up late and holds most of the energy."""
    t = np.arange(round(0.15 * RATE_HZ)) / RATE_HZ
    ringing = np.where(t > 0.01, np.sin(2 * np.pi * 700 * t) * np.exp(-t / 0.04), 0.0)
    direct = heard(OFFSETS_S["cam1"])
    room = fftconvolve(direct.samples, ringing)[: len(direct.samples)]
    sounds = {
        "cam0": SOUNDS["cam0"],
        "cam1": replace(direct, samples=(direct.samples + room).astype(np.float32)),
    }
    result = synchronise({n: SPANS[n] for n in sounds}, sounds, {})
    assert result.cameras["cam1"].offset_s == pytest.approx(0.21, abs=5e-4)


def test_d5_wind_is_left_out():
    rng = np.random.default_rng(4)
    rumble = np.cumsum(rng.normal(size=5 * RATE_HZ))
    rumble = (rumble - np.convolve(rumble, np.full(4800, 1 / 4800), "same")) / 200
    windy = replace(SOUNDS["cam1"], samples=(SOUNDS["cam1"].samples + rumble).astype(np.float32))
    result = synchronise({n: SPANS[n] for n in NAMES[:2]}, {"cam0": SOUNDS["cam0"], "cam1": windy}, {})
    assert result.cameras["cam1"].offset_s == pytest.approx(0.21, abs=5e-4)


def test_d8_sound_that_lags_in_one_camera():
    sounds = SOUNDS | {"cam1": heard(OFFSETS_S["cam1"], lag_s=0.05)}
    result = synchronise(SPANS, sounds, MOTION, extras=Extras(LIGHT))
    clock = result.cameras["cam1"]
    assert clock.method == "flash" and abs(clock.offset_s - 0.21) < min(0.01, 3 * clock.std_s)
    row = rows_of(result)["clocks-disagree flash against sound, cam0 and cam1"]
    assert row.verdict == "warn" and row.value == pytest.approx(50, abs=10)
    assert "calibration.sync.av_lag_s: {cam1: 0.0" in row.remedy
    told = synchronise(SPANS, sounds, MOTION, extras=Extras(LIGHT, av_lag_s={"cam1": 0.05}))
    assert told.cameras["cam1"].offset_s == pytest.approx(0.21, abs=2e-4)
    assert {row.verdict for row in rows_of(told).values()} == {"ok"}


def test_d10_a_clock_that_drifts():
    claps = tuple(np.cumsum(np.random.default_rng(2).uniform(0.5, 2.0, 45)))
    cameras = {n: camera(60.0) for n in NAMES[:2]}
    sounds = {"cam0": heard(0.0, claps, 0.0, 60.0), "cam1": heard(0.5, claps, 45.0, 60.0)}
    result = synchronise({n: (0.0, 60.0 - 1 / FPS) for n in cameras}, sounds, {})
    assert result.cameras["cam1"].drift_ppm == pytest.approx(45.0, abs=10)
    assert not any(name.startswith("clip-times") for name in rows_of(result, cameras))


def test_d13_a_wrong_time_base():
    clocks = {n: Clock(0.0, 1000.0 if n == "cam1" else 0.0, 1e-3, "audio", 0.8, "") for n in NAMES}
    row = rows_of(SyncResult(clocks))["clip-times cam1"]
    assert row.verdict == "warn" and "cam1 +1000 ppm: +5.0 ms" in str(row.value)
    assert "29.97" in row.remedy


def test_d15_no_better_than_frames():
    motion = synchronise({n: SPANS[n] for n in NAMES[:2]}, {}, {n: MOTION[n] for n in NAMES[:2]})
    row = rows_of(motion)["clock-vague cam1"]
    assert row.verdict == "warn" and "17 ms" in row.remedy


def test_d16_d17_d18_flashes_are_placed_missed_and_refused():
    placed = synchronise(SPANS, {}, {}, "flash", extras=Extras(LIGHT))
    assert "camera cam0: 3 flashes (" in notes_of(placed) and "row" in notes_of(placed)
    missed = synchronise(SPANS, {}, {}, "flash", extras=Extras(LIGHT | {"cam2": lit(-0.13, ())}))
    row = rows_of(missed)["clock-unknown cam2"]
    assert row.verdict == "warn" and "cam2: saw no flash" in row.remedy
    blinking = {n: lit(o, tuple(np.arange(0.2, 4.6, 0.4))) for n, o in OFFSETS_S.items()}
    periodic = synchronise(SPANS, {}, {}, "flash", extras=Extras(blinking))
    assert rows_of(periodic)["clock-unknown cam1"].verdict == "fail"
    assert "periodic" in notes_of(periodic)


def test_d20_views_that_disagree():
    rng = np.random.default_rng(1)
    walk = {n: np.stack([np.arange(149) / FPS, 1 + rng.random(149)], 1) for n in NAMES[:2]}
    result = synchronise({n: SPANS[n] for n in walk}, {}, walk)
    row = rows_of(result)["clock-unknown cam1"]
    assert row.verdict == "warn" and "geometry" in row.remedy  # something does move
    assert re.search(r"motion .*correlation", notes_of(result))
    (late,) = judge(unknown_clocks(result.cameras, "nothing moves in both across epipolar lines", CAMERAS))
    assert late.verdict == "fail" and "epipolar" in late.remedy
    found = refined(result.cameras, check(cam1=(0.01, 1e-3)))
    assert found["cam1"].method == "geometry" and not unknown_clocks(found, "", CAMERAS)


@pytest.mark.parametrize(
    ("fps", "std_s", "method", "verdict"),
    [
        (25.0, 0.03, "motion", "warn"),
        (60.0, 0.03, "motion", "fail"),  # tracking tries three pictures
        (25.0, 0.08, "motion", "fail"),
        (25.0, 0.03, "audio", "fail"),
        (25.0, math.inf, "none", "fail"),
    ],
)
def test_a_guess_by_motion_that_tracking_can_mend_is_no_refusal(
    fps: float, std_s: float, method: Cue, verdict: str
) -> None:
    clocks = {
        "cam0": Clock(0.0, 0.0, 0.0, "reference", 1.0, ""),
        "cam1": Clock(0.1, 0.0, std_s, method, 0.49, "a guess"),
    }
    (row,) = judge(unknown_clocks(clocks, "", {name: camera(fps=fps) for name in clocks}))
    assert (row.code, row.about, row.verdict) == ("clock-unknown", "cam1", verdict)


def test_d21_a_loop_that_does_not_close():
    clocks = {n: Clock(0.0, 0.0, 1e-3, "audio", 0.8, "") for n in NAMES}
    result = SyncResult(clocks, loop_s=0.0137, loops=(Loop(NAMES, "audio", 0.041),))
    row = rows_of(result)["clocks-disagree"]
    assert row.verdict == "warn" and re.search("cam0 - cam1 - cam2 .* 41 ms", row.remedy)


def test_d24_clips_that_do_not_overlap():
    clocks = {n: Clock(5.8 * i, 0.0, 1e-3, "audio", 0.8, "") for i, n in enumerate(NAMES)}
    row = rows_of(SyncResult(clocks))["cameras-apart"]
    assert row.verdict == "fail" and "cam2: 11.60 to 16.57 s" in row.remedy
    apart = {n: Recorded(1.7e9 + 60 * i) for i, n in enumerate(NAMES)}
    result = synchronise(SPANS, {}, {}, extras=Extras(recorded=apart))
    assert any("cam1" in note and "+60.0 s after cam0" in note for note in result.notes)


def test_d24_clips_of_which_each_overlaps_only_the_next_are_modelled():
    """From 3.8 to 8.8 s two training cameras or one film: no time that all show, but nothing to refuse."""
    clocks = {n: Clock(3.8 * i, 0.0, 1e-3, "audio", 0.8, "") for i, n in enumerate(NAMES)}
    row = rows_of(SyncResult(clocks))["cameras-apart"]
    assert row.verdict == "warn" and "cam2: 7.60 to 12.57 s" in row.remedy


@pytest.mark.parametrize("role", ["camera", "test"])
def test_d24_a_camera_that_films_when_the_others_do_not_is_named(role: str):
    """Stage `scene` leaves it out; what the others film together is modelled."""
    cameras = {n: camera(2.0) for n in NAMES} | {"late": camera(2.0, role=role)}
    clocks = {n: Clock(2.5 if n == "late" else 0.0, 0.0, 1e-3, "audio", 0.8, "") for n in cameras}
    row = rows_of(SyncResult(clocks), cameras)["cameras-apart"]
    named = row.remedy.split("(")[0]
    assert row.verdict == "warn" and "late" in named and not any(name in named for name in NAMES)
    assert row.fail is None and isinstance(row.value, float) and row.value < 0


def test_d24_the_only_training_camera_needs_no_other():
    """A test camera that shows nothing of its time is a warning; training cameras without each other are a refusal."""
    for role, verdict in (("test", "warn"), ("camera", "fail")):
        cameras = {"cam0": camera(2.0), "late": camera(2.0, role=role)}
        clocks = {"cam0": HEARD["cam0"], "late": Clock(2.5, 0.0, 1e-3, "audio", 0.8, "")}
        assert rows_of(SyncResult(clocks), cameras)["cameras-apart"].verdict == verdict


@pytest.mark.parametrize("hours", [1, -7, 24])
def test_d25_a_clock_set_to_another_zone(hours):
    recorded = {n: Recorded(1.7e9 + o + (3600 * hours if n == "cam1" else 0)) for n, o in OFFSETS_S.items()}
    result = synchronise(SPANS, SOUNDS, {}, extras=Extras(recorded=recorded))
    (said,) = (note for note in result.notes if " h off" in note)
    assert "cam1" in said and f"{hours:+.1f} h off" in said
    assert result.cameras["cam1"].offset_s == pytest.approx(0.21, abs=2e-4)


def test_timecodes_count_frames_and_drop_some():
    assert timecode_s("01:00:00:15", 30.0) == pytest.approx(3600.5)
    assert timecode_s("00:10:00;00", 30000 / 1001) == pytest.approx(600.0, abs=0.01)  # what drop frame is for
    assert timecode_s("tomorrow", 30.0) is None


# --- once cameras are known ---


def check(**offsets_s: tuple[float, float]) -> GeometryCheck:
    """A check that found these (offset, standard deviation)."""
    corrections = {
        n: ClockCorrection(o, s, s < 0.5 / FPS, abs(o) > max(0.25 / FPS, 3 * s))
        for n, (o, s) in offsets_s.items()
    }
    return GeometryCheck((), corrections, corrections, (), ("cam0 and cam2: not observable, ...",))


HEARD = {n: Clock(o, 0.0, 1e-3, "audio" if o else "reference", 0.9, "") for n, o in OFFSETS_S.items()}


def against(found: GeometryCheck, clocks: dict[str, Clock], used: dict[str, Clock]) -> dict[str, HealthRow]:
    return judged(check_measures(found, clocks, used, CAMERAS))


def test_d22_d23_geometry_against_the_clocks():
    right = against(check(cam1=(0.001, 1e-3), cam2=(-0.002, 1e-3)), HEARD, HEARD)
    assert [row.verdict for row in right.values()] == ["ok"]
    late = against(check(cam1=(-0.012, 1e-3), cam2=(0.0, 1e-3)), HEARD, HEARD)["clocks-disagree cam1"]
    assert late.verdict == "warn" and "cam1: audio says 0, geometry -12.0 ms" in late.remedy
    assert "calibration.sync.av_lag_s: {cam1: -0.012}" in late.remedy


def test_clips_too_short_for_geometry_keep_their_clocks(tmp_path: Path):
    short = {name: camera(seconds=0.3) for name in NAMES}
    views = timed_pictures(tmp_path, short, {}, HEARD, {})
    assert clock_check(views, short, HEARD, no_progress) == (HEARD, [], {})


def test_a_camera_that_films_when_the_others_do_not_is_left_out_of_geometry(tmp_path: Path):
    """The others are compared with each other."""
    for n in range(60):
        write_png(tmp_path / f"{n}.png", np.zeros((48, 64), np.uint8))
    clips = {name: camera(2.0) for name in ("cam0", "cam1", "late")}
    clocks = {n: Clock(2.5 if n == "late" else 0.0, 0.0, 1e-3, "audio", 0.8, "") for n in clips}
    lens = Camera(64, 48, np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1.0]]), np.eye(3, 4))
    views = timed_pictures(tmp_path, clips, dict.fromkeys(clips, lens), clocks, {})
    assert list(views) == ["cam0", "cam1"]
    assert all(len(view.time_s) == len(view.grey) >= MIN_FRAMES for view in views.values())


def test_clocks_by_geometry_say_how_unsure_they_are():
    """Half a second of doubt is no clock; two frames are a warning, what is sharp is fine."""
    none = {
        n: Clock(0.0, 0.0, np.inf if i else 0.0, "none" if i else "reference", 0.0, "")
        for i, n in enumerate(NAMES)
    }
    for std_s, verdict in ((0.2 / FPS, "ok"), (2.0 / FPS, "warn"), (0.5, "fail")):
        found = check(cam1=(0.01, std_s))
        row = against(found, none, refined(none, found))["clock-vague cam1"]
        assert row.verdict == verdict and bool(row.remedy) == (verdict != "ok")


def test_a_table_of_times_that_is_late_is_told_by_how_much():
    table = {n: Clock(0.0, 0.0, 1e-3, "timestamps", 0.9, "") for n in NAMES}
    (row,) = against(check(cam1=(-0.117, 1e-3)), table, table).values()
    assert row.verdict == "warn" and "-0.117 s" in row.remedy and "capture.timestamps" in row.remedy
