"""Clocks: claps with known offsets in echo and noise, real speech, motion, and what must be refused."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import fftconvolve
from tests.refused import refused

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.equations import Clock, Equation, consistent
from devrf.calibration.clocks.flash import Brightness
from devrf.calibration.clocks.motion import motion_delay
from devrf.calibration.clocks.sound import gcc_phat, sound_delay
from devrf.calibration.clocks.sync import _with_guesses, synchronise
from devrf.capture.ingest.signals import CourseMeter
from devrf.capture.system.errors import CalibrationError
from devrf.capture.video.audio import Sound, read_sound
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.recorded import Recorded

RATE_HZ = 48_000
NAMES = ("cam0", "cam1", "cam2", "cam3", "witness")
OFFSETS_S = np.array([0.0, 0.4317, -0.2291, 0.1713, 0.0508])


def claps(
    rng: np.random.Generator,
    times_s: Sequence[float],
    offset_s: float,
    drift_ppm: float = 0.0,
    duration_s: float = 5.0,
    noise: float = 0.02,
    echo: float = 0.5,
) -> Sound:
    """What a clock with this offset and drift records of claps: decaying noise, the same for all cameras,
    sub-sample delays (in the frequency domain), a room's echoes of its own, and its own noise."""
    n = int(duration_s * RATE_HZ)
    shape = np.random.default_rng(99)
    burst = shape.normal(size=1200) * np.exp(-np.arange(1200) / 150)
    burst = np.fft.rfft(burst, 4096)
    sound = np.zeros(n + 4096)
    for time_s in times_s:
        at = (time_s - offset_s) / (1 + 1e-6 * drift_ppm) * RATE_HZ
        if 0 <= at < n - 4096:
            shift = np.exp(-2j * np.pi * np.fft.rfftfreq(4096) * (at % 1))
            sound[int(at) : int(at) + 4096] += np.fft.irfft(burst * shift, 4096)
    tail = int(0.3 * RATE_HZ)
    room = echo * rng.normal(size=tail) * np.exp(-np.arange(tail) / (0.06 * RATE_HZ)) / 20
    room[: int(0.003 * RATE_HZ)] = 0
    room[0] = 1
    sound = fftconvolve(sound, room)[:n]
    sound = sound / np.abs(sound).max() + noise * rng.normal(size=n)
    return Sound(0.3 * sound.astype(np.float32), RATE_HZ, 0.0)


def spans(duration_s: float = 5.0, names: tuple[str, ...] = NAMES) -> dict[str, tuple[float, float]]:
    return {name: (0.0, duration_s) for name in names}


@pytest.mark.parametrize("noise, echo", [(0.01, 0.0), (0.02, 0.5), (0.1, 1.0)])
def test_claps_within_a_millisecond(noise, echo):
    rng = np.random.default_rng(5)
    times = [1.03, 1.71, 2.94, 3.36]
    sounds = {n: claps(rng, times, o, noise=noise, echo=echo) for n, o in zip(NAMES, OFFSETS_S, strict=True)}
    result = synchronise(spans(), sounds, {})
    got = np.array([result.cameras[n].offset_s for n in NAMES])
    assert 1e3 * np.abs(got - OFFSETS_S).max() < 0.2
    for name in NAMES[1:]:
        clock = result.cameras[name]
        assert clock.method == "audio" and clock.confidence >= 0.5 and clock.std_s < 1e-3
        assert clock.drift_ppm == 0  # five seconds cannot show it
        assert abs(clock.offset_s - OFFSETS_S[NAMES.index(name)]) < 4 * clock.std_s
    assert result.cameras["cam0"] == Clock(0.0, 0.0, 0.0, "reference", 1.0, "its clock is the session's")
    assert result.loop_s is not None and result.loop_s < 1e-3
    curve = next(c for c in result.curves if (c.first, c.second) == ("cam0", "cam1"))
    assert curve.lags_s[np.argmax(curve.values)] == pytest.approx(0.4317, abs=1e-3)


def test_start_times_of_the_sound_count_but_neither_polarity_nor_level():
    rng = np.random.default_rng(1)
    a, b = (claps(rng, [1.0, 2.3, 2.9], o) for o in (0.0, 0.2))
    late = Sound(b.samples[4800:], RATE_HZ, 0.1)
    found = sound_delay(a, late)
    assert found is not None and found.correlation.delay_s == pytest.approx(0.2, abs=2e-5)
    found = gcc_phat(a, Sound(-0.05 * b.samples, RATE_HZ, 0.0))
    assert found.delay_s == pytest.approx(0.2, abs=2e-5) and found.ratio > 2


def test_drift_shows_in_long_clips():
    rng = np.random.default_rng(2)
    times = list(np.cumsum(rng.uniform(0.8, 4.0, 18)))
    duration_s, names = 45.0, ("cam0", "cam1")
    truth = {"cam0": (0.0, 0.0), "cam1": (2.5, 45.0)}
    sounds = {n: claps(rng, times, o, d, duration_s, noise=0.01, echo=0.3) for n, (o, d) in truth.items()}
    result = synchronise(spans(duration_s, names), sounds, {})
    for name, (offset_s, drift_ppm) in truth.items():
        clock = result.cameras[name]
        assert clock.drift_ppm == pytest.approx(drift_ppm, abs=10)
        at = np.array([0.0, 20.0, 40.0])
        error = clock.true_time(at) - (offset_s + (1 + 1e-6 * drift_ppm) * at)
        assert 1e3 * np.abs(error).max() < 0.5


@pytest.mark.full
def test_real_speech(data_dir):
    folder = data_dir / "audio_offset"
    one, two = read_sound(folder / "timbl_1.mp3"), read_sound(folder / "timbl_2.mp3")
    assert one is not None and two is not None
    found = sound_delay(one, two)
    assert found is not None and found.accepted
    # The reference was measured on the decoded samples alone. The first file's own timestamps begin at
    # 23 ms (its encoder's delay, which the second file does not announce), so that is taken out here.
    delay_s = found.correlation.delay_s - (one.start_s - two.start_s)
    assert delay_s == pytest.approx(12.2539, abs=2e-3)
    for moment in found.moments:
        assert moment.first_s - moment.second_s == pytest.approx(found.correlation.delay_s, abs=2e-3)


def energy(rng: np.random.Generator, offset_s: float, fps: float, noise: float, seconds: float = 12.0):
    """Motion energy of uneven gestures at known times, seen by a clock with this offset."""
    gestures = np.random.default_rng(7)
    at, size = gestures.uniform(0, seconds, 14), gestures.uniform(0.4, 1.5, 14)
    file_s = np.arange(0, seconds - 1, 1 / fps) + rng.uniform(0, 1 / fps)
    true_s = file_s[:, None] + offset_s
    course = (size * np.exp(-(((true_s - at) / 0.15) ** 2))).sum(1)
    gain = rng.uniform(0.5, 2.0)
    return np.stack([file_s, gain * (course + 0.05 + noise * np.abs(rng.normal(size=len(file_s))))], 1)


@pytest.mark.parametrize("fps_b", [30.0, 60.0, 25.0])
def test_motion_within_half_a_frame(fps_b):
    rng = np.random.default_rng(3)
    for offset_s in (0.0, 0.41, -0.673):
        found = motion_delay(energy(rng, 0.0, 30.0, 0.05), energy(rng, offset_s, fps_b, 0.05))
        assert found is not None and found.accepted
        assert abs(found.delay_s - offset_s) < 0.5 / 25 and found.std_s >= 0.49 / min(30, fps_b)


def test_silent_camera_is_put_on_the_clock_by_motion():
    rng = np.random.default_rng(4)
    names, offsets = ("cam0", "cam1", "cam2"), (0.0, 0.25, -0.4)
    sounds = {n: claps(rng, [1.0, 2.2, 3.9], o) for n, o in zip(names[:2], offsets[:2], strict=True)}
    motion = {n: energy(rng, o, 30.0, 0.05) for n, o in zip(names, offsets, strict=True)}
    result = synchronise(spans(11.0, names), sounds, motion)
    assert [result.cameras[n].method for n in names] == ["reference", "audio", "motion"]
    assert result.cameras["cam1"].offset_s == pytest.approx(0.25, abs=1e-3)
    assert result.cameras["cam2"].offset_s == pytest.approx(-0.4, abs=1 / 60)
    assert result.cameras["cam2"].std_s > result.cameras["cam1"].std_s
    assert any(n.startswith("camera cam2: no sound") for n in result.notes)


def test_a_steady_beat_is_ambiguous_until_motion_tells_which_beat():
    rng = np.random.default_rng(6)
    beat = list(np.arange(0.1, 8.0, 0.5))
    sounds = {n: claps(rng, beat, o, duration_s=6.0) for n, o in (("cam0", 0.0), ("cam1", 0.2))}
    found = sound_delay(sounds["cam0"], sounds["cam1"])
    assert found is not None and not found.accepted and found.correlation.ratio < 2
    motion = {n: energy(rng, o, 30.0, 0.05) for n, o in (("cam0", 0.0), ("cam1", 0.2))}
    alone = synchronise(spans(6.0, ("cam0", "cam1")), sounds, {})
    assert alone.cameras["cam1"].confidence < 0.5
    assert any("sound" in n and "0.50 s" in n for n in alone.notes)
    result = synchronise(spans(6.0, ("cam0", "cam1")), sounds, motion)
    clock = result.cameras["cam1"]
    assert clock.method == "audio" and 0.5 <= clock.confidence <= 0.75
    assert clock.offset_s == pytest.approx(0.2, abs=2e-4)  # as claps: far below motion's half frame
    assert any(n.startswith("cam0 and cam1: sound") and n.endswith("by motion") for n in result.notes)


def test_nothing_in_common_gives_no_confidence():
    rng = np.random.default_rng(8)
    noise = {n: Sound(rng.normal(size=3 * RATE_HZ).astype(np.float32) * 0.1, RATE_HZ, 0.0) for n in NAMES[:2]}
    walk = {n: np.stack([np.arange(80) / 30, 1 + rng.random(80)], 1) for n in NAMES[:2]}
    result = synchronise(spans(3.0, NAMES[:2]), noise, walk)
    assert result.cameras["cam1"].confidence < 0.5
    still = {n: np.stack([np.arange(80) / 30, np.ones(80)], 1) for n in NAMES[:2]}
    result = synchronise(spans(3.0, NAMES[:2]), {}, still)
    clock = result.cameras["cam1"]
    assert (clock.offset_s, clock.confidence, clock.method) == (0.0, 0.0, "none")
    assert any(n.startswith("cam0 and cam1: too little motion") for n in result.notes)


def test_periodic_motion_is_refused():
    t = np.arange(0, 10, 1 / 30)
    walk = np.stack([t, 2 + np.sin(2 * np.pi * 1.2 * t)], 1)
    found = motion_delay(walk, walk + [0.3, 0.0])
    assert found is not None and not found.accepted


@pytest.mark.parametrize("end", [False, True])
def test_rest_beyond_the_clips_tells_which_half_of_a_movement_is_which(end: bool) -> None:
    """To and fro: one view sees more of the way there, the other of the way back."""
    time_s = np.arange(0, 3.4, 1 / 25)

    def clip(*sizes: float) -> np.ndarray:
        at_s = (0.8, 1.8, 2.6)
        bumps = [size * np.exp(-(((time_s - at) / 0.2) ** 2)) for at, size in zip(at_s, sizes, strict=True)]
        course = np.sum(bumps, axis=0) ** 2 + 0.01
        return np.stack([time_s, course[::-1] if end else course], axis=1)

    one, other = clip(0.9, 1.0, 0.3), clip(1.0, 0.2, 0.3)
    alone = motion_delay(one, other)
    assert alone is not None and abs(alone.delay_s) > 0.9
    found = motion_delay(one, other, "end" if end else "start")
    assert found is not None and abs(found.delay_s) < 0.1 and not found.accepted
    cut = one[(time_s > 0.7) & (time_s < 2.7)], other[(time_s > 0.7) & (time_s < 2.7)]
    moving = [motion_delay(*cut, rest) for rest in ("none", "end" if end else "start")]
    delays_s = {None if m is None else m.delay_s for m in moving}
    assert len(delays_s) == 1  # a clip that begins in motion says nothing of before


def test_of_guesses_those_count_that_most_others_agree_with() -> None:
    def equation(
        a: str, b: str, delay_s: float, quality: float, score: float, accepted: bool = False
    ) -> Equation:
        return Equation(a, b, 2.0, 2.0 - delay_s, 0.04, "motion", quality, accepted, not accepted, score)

    names = ("cam0", "cam1", "cam2", "cam3")
    sure = [equation("cam1", "cam2", 0.1, 0.9, 5.0, True), equation("cam2", "cam3", 0.0, 0.9, 5.0, True)]
    wrong = equation("cam0", "cam2", 1.0, 0.9, 2.8)
    right = [equation("cam0", "cam1", -0.08, 0.6, 2.3), equation("cam0", "cam3", 0.03, 0.5, 2.4)]
    used = _with_guesses(spans(4.0, names), sure, [wrong, *right])
    assert len(used) == 3 and used[-1] in right
    assert _with_guesses(spans(4.0, names), sure, [wrong, right[0]])[-1] is wrong  # one each: the higher
    heard = Equation("cam0", "cam1", 2.0, 1.5, 0.001, "audio", 2.0, False, True)
    assert _with_guesses(spans(4.0, names), sure, [wrong, *right, heard])[-1] is heard


def edge(kind: str, pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Grey pictures of a clip, of which some at an edge of the file are not as the scene is."""
    first, last = pictures[0], pictures[-1]
    if kind == "black":
        return [0 * first, *pictures[1:]]
    if kind == "green":
        return [0 * first + 80, 0 * first + 80, *pictures[2:]]
    if kind == "black at the end":
        return [*pictures[:-2], 0 * last, 0 * last]
    if kind == "one too bright":
        return [*pictures[:3], np.clip(pictures[3].astype(int) + 90, 0, 255).astype(np.uint8), *pictures[4:]]
    gains = 1 - 0.6 * np.exp(-np.arange(10) / 3)  # exposure that settles in a third of a second
    settling = [(gain * p).astype(np.uint8) for gain, p in zip(gains, pictures, strict=False)]
    return [*settling, *pictures[10:]]


@pytest.mark.full
@pytest.mark.parametrize("kind", ["black", "green", "black at the end", "one too bright", "settles"])
def test_what_happens_at_the_edges_of_files_is_not_the_scene(data_dir: Path, kind: str) -> None:
    """The true clocks, or none: silent clips."""
    true_s = {"cam0": 0.0, "cam1": 0.2317, "cam2": -0.1483, "cam3": 0.0871}
    motion, brightness = {}, {}
    for name in true_s:
        with VideoReader(data_dir / "kuka_room" / f"{name}.mp4") as reader:
            frames = [(frame.time_s, frame.stored_grey(160)) for frame in reader]
        meter = CourseMeter()
        for (time_s, _), grey in zip(frames, edge(kind, [grey for _, grey in frames]), strict=True):
            meter.add(time_s, grey)
        courses = meter.courses()
        motion[name] = courses.motion
        brightness[name] = Brightness(courses.brightness[:, 0], courses.brightness[:, 1:])
    result = synchronise(spans(2.0, tuple(true_s)), {}, motion, extras=Extras(brightness))
    for name, offset_s in true_s.items():
        clock = result.cameras[name]
        assert clock.confidence < 0.5 or abs(clock.offset_s - offset_s) <= 3 * max(clock.std_s, 1 / 60)


def test_exposure_that_settles_as_files_begin_tells_no_time() -> None:
    """Within a third of a second, and hardly anything moves; six pairs agree on it."""
    rng, names = np.random.default_rng(5), NAMES[:4]
    time_s = np.arange(59) / 30
    settling = np.exp(-time_s / 0.12) * (time_s < 0.35)
    motion = {
        name: np.stack([time_s, 1 + 0.15 * rng.random(59) + rng.uniform(1.2, 1.8) * settling], axis=1)
        for name in names
    }
    result = synchronise(spans(2.0, names), {}, motion)
    assert all(result.cameras[name].confidence < 0.5 for name in names[1:])
    assert any(n.startswith("cam0 and cam1: motion not trusted") and "0.5 s" in n for n in result.notes)


def test_a_short_clip_is_not_taken_for_its_ends():
    time_s = np.arange(15) / 25
    clip = np.stack([time_s, 1 + np.exp(-(((time_s - 0.3) / 0.06) ** 2))], axis=1)
    found = motion_delay(clip, clip)
    assert found is not None and found.delay_s == pytest.approx(0.0, abs=0.5 / 25)


def test_a_pair_that_contradicts_the_others_is_dropped():
    """One camera's microphone lags: all its pairs agree with each other. One wrong pair alone does not."""

    def equation(a: str, b: str, delay_s: float) -> Equation:
        return Equation(a, b, 2.0, 2.0 - delay_s, 1e-4, "audio", 5.0)

    names, offsets = NAMES[:4], OFFSETS_S[:4]
    equations = [
        equation(names[i], names[j], offsets[j] - offsets[i]) for i, j in itertools.combinations(range(4), 2)
    ]
    equations[3] = equation(names[1], names[2], 0.026)
    kept, dropped = consistent(spans(names=names), equations)
    assert [(e.a, e.b) for e in dropped] == [("cam1", "cam2")] and len(kept) == 5


def test_methods_that_need_nothing():
    result = synchronise(spans(), {}, {}, "auto", extras=Extras(true_times=True))
    assert {c.method for c in result.cameras.values()} == {"timestamps"}
    assert all(c.confidence == 1 and c.std_s == 0 for c in result.cameras.values())
    result = synchronise(spans(), {}, {}, "none")
    assert {c.method for c in result.cameras.values()} == {"none"} and result.notes
    assert synchronise(spans(names=("only",)), {}, {}).cameras["only"].method == "reference"


def test_clocks_by_timecode_where_it_is_asked_for():
    stated = {n: Recorded(None, 36_000.0 + i, 25.0) for i, n in enumerate(NAMES)}
    result = synchronise(spans(), {}, {}, "timestamps", extras=Extras(recorded=stated))
    assert [c.offset_s for c in result.cameras.values()] == pytest.approx(list(range(len(NAMES))))
    assert all(0.5 < c.confidence < 1 for c in list(result.cameras.values())[1:])


def test_methods_that_cannot_be_used():
    with refused("timestamps-missing", "capture.timestamps", "cam1", kind=CalibrationError):
        synchronise(spans(), {}, {}, "timestamps")
    rng = np.random.default_rng(0)
    with refused("sound-missing", "cam1, cam2, cam3, witness", kind=CalibrationError):
        synchronise(spans(), {"cam0": claps(rng, [1.0], 0.0)}, {}, "audio")


def test_true_time():
    clock = Clock(0.5, 100.0, 0.0, "audio", 1.0, "")
    np.testing.assert_allclose(clock.true_time(np.array([0.0, 10.0])), [0.5, 10.501], rtol=0, atol=1e-12)


def test_clocks_that_are_known_stand_and_another_is_put_on_them():
    rng = np.random.default_rng(5)
    times = [1.03, 1.71, 2.94, 3.36]
    sounds = {n: claps(rng, times, o) for n, o in zip(NAMES, OFFSETS_S, strict=True)}
    trained = spans(names=NAMES[:-1])
    known = synchronise(trained, {n: sounds[n] for n in trained}, {}).cameras
    placed = synchronise(spans(), sounds, {}, extras=Extras(known=known))
    assert {n: placed.cameras[n] for n in trained} == known
    assert placed.cameras["witness"].offset_s == pytest.approx(OFFSETS_S[-1], abs=2e-4)
    assert placed.cameras["witness"].method == "audio" and placed.cameras["witness"].confidence >= 0.5
    assert {frozenset((c.first, c.second)) for c in placed.curves} == {
        frozenset((n, "witness")) for n in trained
    }
    assert all("witness" in loop.cameras for loop in placed.loops)


def test_a_camera_beside_known_clocks_that_no_cue_reaches_keeps_a_guess():
    rng = np.random.default_rng(5)
    sounds = {n: claps(rng, [1.03, 1.71, 2.94], o) for n, o in zip(NAMES[:2], OFFSETS_S, strict=False)}
    known = synchronise(spans(names=NAMES[:2]), sounds, {}).cameras
    placed = synchronise(spans(names=(*NAMES[:2], "witness")), sounds, {}, extras=Extras(known=known))
    assert placed.cameras["witness"].confidence == 0 and placed.loop_s is None
    assert placed.cameras["cam1"] == known["cam1"]
