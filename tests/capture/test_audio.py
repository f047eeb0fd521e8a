"""Sound: true start times through AAC, resampling and gaps."""

from pathlib import Path

import av
import numpy as np
import pytest

from devrf.capture.video.audio import Sound, _channels, _place, read_sound, read_wav, write_wav
from devrf.capture.video.audio_channels import ChannelLoudness, choose


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


def test_eight_bits_rest_in_the_middle():
    frame = av.AudioFrame.from_ndarray(np.array([[128, 192, 0]], np.uint8), format="u8", layout="mono")
    np.testing.assert_allclose(_channels(frame), [[0, 0.5, -1]])


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


RATE_HZ = 48_000
CLAPS_S = (0.5, 1.1)


def track_file(path: Path, *tracks: np.ndarray) -> Path:
    """A file with sound tracks, each an array [channels, samples] in [-1, 1]."""
    with av.open(str(path), "w") as out:
        streams = [
            out.add_stream("pcm_s16le", rate=RATE_HZ, layout="stereo" if len(t) == 2 else "mono")
            for t in tracks
        ]
        for track, stream in zip(tracks, streams, strict=True):
            for at in range(0, track.shape[1], 1024):
                values = (track[:, at : at + 1024].T * 32767).astype(np.int16).reshape(1, -1)
                frame = av.AudioFrame.from_ndarray(values, format="s16", layout=stream.layout.name)
                frame.sample_rate, frame.pts = RATE_HZ, at
                for packet in stream.encode(frame):
                    out.mux(packet)
    return path


def microphone(seed: int = 0, level: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 2e-3, int(1.5 * RATE_HZ))
    return level * (clicks(RATE_HZ, list(CLAPS_S), 1.5) + noise)


HUM = np.sin(2 * np.pi * 50 * np.arange(int(1.5 * RATE_HZ)) / RATE_HZ)
SILENT = np.zeros_like(HUM)
HISS = np.random.default_rng(9).normal(0, 3e-4, len(HUM))  # of a socket that nothing is plugged into


@pytest.mark.parametrize(
    ("tracks", "expected", "named"),
    [
        ([np.stack([microphone(), -microphone()])], microphone(), "channel 1 of 2"),
        ([np.stack([microphone(), microphone()])], microphone(), ""),
        ([np.stack([microphone(), SILENT])], microphone() / 2, ""),
        ([np.stack([0.9 * HUM, microphone(level=0.05)])], microphone(level=0.05), "channel 2 of 2"),
        ([SILENT[None], microphone()[None]], microphone(), "track 2 of 2"),
        ([HISS[None], microphone()[None]], microphone(), "track 2 of 2"),
        (
            [HUM[None], np.stack([microphone(), -microphone()])],
            microphone(),
            "channel 1 of 2 in track 2 of 2",
        ),
        ([microphone()[None], microphone(1)[None]], microphone(), ""),
        ([np.stack([SILENT, SILENT])], SILENT, ""),
    ],
    ids=["opposed", "equal", "one", "hum", "second track", "hiss", "hum in track 1", "two tracks", "silent"],
)
def test_the_channel_in_which_something_is_to_be_heard(tmp_path, tracks, expected, named):
    sound = read_sound(track_file(tmp_path / "a.mkv", *tracks))
    assert sound is not None and bool(sound.taken) == bool(named) and sound.taken.startswith(named)
    np.testing.assert_allclose(sound.samples, expected, atol=2e-4)


def test_blocks_of_another_number_of_channels_do_not_choose():
    """Broadcasts change from two channels to six in the middle."""
    heard, values = ChannelLoudness(), microphone()[None]
    for block in (np.concatenate([values, -values]), np.repeat(values, 6, axis=0)):
        heard.add(block.astype(np.float32))
    choice = choose([ChannelLoudness(), heard])
    assert choice.channel == 0 and choice.why.startswith("channel 1 of 2 in track 2 of 2")
