"""Sound: true start times through AAC, resampling and gaps."""

import numpy as np
import pytest

from devrf.capture.audio import Sound, _place, read_sound, read_wav, write_wav


def clicks(rate_hz: int, times_s: list[float], duration_s: float) -> np.ndarray:
    """A short 2 kHz burst at each time."""
    t = np.arange(int(duration_s * rate_hz)) / rate_hz
    out = np.zeros(len(t))
    for at in times_s:
        out += np.exp(-(((t - at) / 0.002) ** 2)) * np.cos(2 * np.pi * 2000 * (t - at))
    return 0.5 * out


@pytest.mark.parametrize("rate_hz", [48_000, 44_100])
def test_sound_keeps_its_time_through_aac(make_clip, pictures, rate_hz):
    wanted = [0.31, 0.77]
    path = make_clip("a.mp4", pictures, sound=clicks(rate_hz, wanted, 1.2), rate_hz=rate_hz)
    sound = read_sound(path)
    assert sound is not None and sound.rate_hz == 48_000 and not sound.silent
    for at in wanted:
        i = int((at - sound.start_s - 0.05) * 48_000)
        energy = np.square(sound.samples[i : i + 4800])
        found = sound.start_s + (i + (energy * np.arange(4800)).sum() / energy.sum()) / 48_000
        assert found == pytest.approx(at, abs=1e-4)


def test_no_sound_and_silence(make_clip, pictures):
    assert read_sound(make_clip("mute.mp4", pictures)) is None
    sound = read_sound(make_clip("silent.mp4", pictures, sound=np.zeros(24_000)))
    assert sound is not None and sound.silent


def test_gaps_become_silence_and_overlaps_are_cut():
    ones = np.ones(100, np.float32)
    samples, start_s = _place([(1.0, ones), (1.1, ones), (1.4, ones)], 1000)
    assert start_s == 1.0 and len(samples) == 500
    assert samples[:200].all() and not samples[200:400].any() and samples[400:].all()
    samples, _ = _place([(0.0, ones), (0.05, 2 * ones)], 1000)
    assert len(samples) == 150 and samples[99] == 1 and samples[100] == 2
    samples, _ = _place([(0.0, ones), (0.1005, ones)], 1000)  # half a millisecond is rounding
    assert len(samples) == 200


def test_wav_round_trip(tmp_path):
    sound = Sound(np.linspace(-1, 1, 1000, dtype=np.float32), 48_000, 0.25)
    write_wav(tmp_path / "a.wav", sound)
    again = read_wav(tmp_path / "a.wav", 0.25)
    np.testing.assert_allclose(again.samples, sound.samples, atol=1 / 32767)
    assert again.end_s == pytest.approx(0.25 + 1000 / 48_000)


def test_real_silent_track(data_dir):
    sound = read_sound(data_dir / "pose2sim_single" / "videos" / "cam02.mp4")
    assert sound is not None and sound.silent
