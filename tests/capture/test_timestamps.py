"""A table of times against the clip it belongs to, and pictures against their sound."""

import av
import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.colour.flicker import judge_light
from devrf.capture.colour.light_course import BANDS, LightCourse
from devrf.capture.video.recorded import rate_faults, timecode_s
from devrf.capture.video.slow_motion import check_filmed_rate, length_faults
from devrf.capture.video.timestamps import FrameTimes, check_table, table_factor, table_faults

CLIP_S = {n: n / 30 for n in range(60)}


def table(step_s: float, start_s: float = 0.0, frames: range = range(60)) -> FrameTimes:
    index = np.array(frames)
    return FrameTimes(index, start_s + step_s * index)


@pytest.mark.parametrize(
    ("step_s", "named"),
    [
        (1e3 / 30, "milliseconds"),
        (1e3 / 240, "milliseconds"),  # of slow motion, eight times
        (1e6 / 30, "microseconds"),
        (1e9 / 30, "nanoseconds"),
        (1e-9, "seconds"),
    ],
)
def test_times_that_are_not_in_seconds(tmp_path, step_s, named):
    times = table(step_s, 1e9)
    with refused("times-unit-wrong", "t.csv", "cam0", named):
        check_table(tmp_path / "t.csv", "cam0", times, table_factor(times, CLIP_S))


@pytest.mark.parametrize(("step_s", "said"), [(1 / 30, 0), (1 / 29.97, 0), (1 / 240, 1), (1.0, 1)])
def test_other_steps_are_used_and_said(tmp_path, step_s, said):
    times = table(step_s, 198158.0, range(0, 60, 7))
    factor = table_factor(times, CLIP_S)
    check_table(tmp_path / "t.csv", "cam0", times, factor)
    assert factor == pytest.approx(30 * step_s, rel=1e-3) and len(table_faults(factor)) == said


def test_a_table_that_no_recording_lasts(tmp_path):
    times = FrameTimes(np.array([0, 1, 2]), np.array([0.0, 0.03, 1e9]))
    with refused("times-too-long", "t.csv", "cam0"):
        check_table(tmp_path / "t.csv", "cam0", times, table_factor(times, {0: 0.0}))


def test_few_pictures_over_a_long_time_need_little_memory():
    """A lamp's lines would be a thousand million, one for each trial frequency."""
    time_s = np.arange(60) * 1e9 / 30
    light = LightCourse(np.arange(60), time_s, np.zeros((60, 3)), np.zeros(60), np.zeros((60, BANDS)))
    assert judge_light(light).flicker is None


@pytest.mark.parametrize(
    ("pictures_s", "sound_s", "fps", "named"),
    [
        (10.0, 10.3, None, None),
        (1.0, 0.3, 25.0, None),
        (80.0, 10.0, 30.0, "itsscale 0.125"),
        (10.0, 5.5, None, "1.82"),
        (5.0, 10.0, None, "0.5"),
        (2.45, 2.0, 24.0, "30 pictures a second written as 24"),
        (62.5, 60.0, 24.0, "25 pictures a second written as 24"),
        (50.0, 60.0, 30_000 / 1001, "25 pictures a second written as 29.97"),
        (60.06, 60.0, 30_000 / 1001, None),  # 29.97 and 30 are told by sound against sound
        (60.0, 59.2, 25.0, None),  # sound that ends early
        (60.0, 54.0, 27.3, None),  # a variable rate
    ],
)
def test_lengths_of_pictures_and_sound(pictures_s, sound_s, fps, named):
    faults = length_faults(pictures_s, sound_s, fps)
    assert len(faults) == (named is not None)
    assert all(named in f"{f.value} {f.facts}" for f in faults)


@pytest.mark.parametrize(("filmed", "factor"), [("240.000000", 9.6), ("25", None), ("fast", None)])
def test_a_clip_that_says_how_fast_it_was_filmed(make_clip, tmp_path, filmed, factor):
    path = tmp_path / "tagged.mp4"
    pictures = np.zeros((5, 48, 64, 3), np.uint8)
    with (
        av.open(str(make_clip("a.mp4", pictures))) as source,
        av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as out,
    ):
        out.metadata["com.android.capture.fps"] = filmed
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    if factor is None:
        check_filmed_rate(path)
    else:
        with refused("clip-slow-motion", path.name, factor, f"{1 / factor:.6g}", "capture.timestamps"):
            check_filmed_rate(path)


@pytest.mark.parametrize(
    ("counted", "fps", "said"),
    [
        (25.0, 25.0, 0),
        (29.97, 59.94, 0),
        (30.0, 119.88, 0),
        (25.0, 24.1, 0),
        (23.976, 59.94, 1),
        (None, 25.0, 0),
    ],
)
def test_rates_of_timecode_and_pictures(counted, fps, said):
    assert len(rate_faults(counted, fps)) == said


@pytest.mark.parametrize(
    ("text", "fps", "seconds"), [("10:00:00;15", 30_000 / 1001, 36000.4645), ("01:00:00:12", 24.0, 3600.5)]
)
def test_timecode_counts_at_the_rate_it_is_given(text, fps, seconds):
    assert timecode_s(text, fps) == pytest.approx(seconds, abs=1e-3)
