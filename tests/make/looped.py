"""A session that goes on for longer: its motion there and back, again and again."""

import json
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml
from tests.make.clips import TIME_BASE, add_pictures

from devrf.capture.video.video_writer import X264


def loop_session(session: Path, target: Path, seconds: float) -> dict[str, list[int]]:
    """Write a simulated session anew with clips that last so long; for each camera, which pictures are shown.

    What all cameras film at the same time is shown there and back, pictures and sound, by clocks that no longer drift.
    What is true of it is left out: its evaluation has no masks.
    """
    truth = json.loads((session / "ground_truth.json").read_text())
    scene = yaml.safe_load((session / "scene.yaml").read_text())
    scene.pop("evaluate", None)
    clips = scene["capture"]["cameras"] | scene["capture"]["test_cameras"]
    clocks = {
        name: _Clock(**{key: truth["cams"][name][key] for key in ("offset_s", "drift_ppm")}) for name in clips
    }
    ends = [clocks[name].true(np.array(truth["cams"][name]["file_times_s"])) for name in clips]
    span = max(times[0] for times in ends), min(times[-1] for times in ends)
    target.mkdir(parents=True)
    shown = {
        name: _loop_clip(session / file, target / file, clocks[name], span, seconds)
        for name, file in clips.items()
    }
    static = scene["capture"]["static"]
    (shutil.copytree if (session / static).is_dir() else shutil.copyfile)(session / static, target / static)
    (target / "scene.yaml").write_text(yaml.safe_dump(scene))
    return shown


class _Clock:
    """True time = offset_s + (1 + 1e-6 drift_ppm) file time."""

    def __init__(self, offset_s: float, drift_ppm: float) -> None:
        self.offset_s, self.rate = offset_s, 1 + 1e-6 * drift_ppm

    def true(self, file_s: np.ndarray) -> np.ndarray:
        return self.offset_s + self.rate * file_s


def _loop_clip(
    source: Path, out: Path, clock: _Clock, span: tuple[float, float], seconds: float
) -> list[int]:
    times_s, pictures, heard, rate = _decoded(source)
    true = clock.true(times_s)
    seen = np.flatnonzero((true >= span[0]) & (true <= span[1]))
    length = span[1] - span[0]
    shown: list[int] = []
    at_s: list[float] = []
    samples = []
    positions = (span[0] + np.arange(round(length * rate)) / rate - clock.offset_s) / clock.rate * rate
    for turn in range(int(np.ceil(seconds / length))):
        order, since = (
            (seen, true[seen] - span[0]) if turn % 2 == 0 else (seen[::-1], span[1] - true[seen[::-1]])
        )
        for n, after in zip(order, since, strict=True):
            when = turn * length + after
            if not at_s or when > at_s[-1] + 1e-3:  # the picture at the turn is there once
                shown.append(int(n))
                at_s.append(when)
        sound = np.interp(positions, np.arange(len(heard)), heard)
        samples.append(sound if turn % 2 == 0 else sound[::-1])
    begin_s = at_s[0]  # files begin with their first picture; sound begins there, too
    whole = np.concatenate(samples)
    ticks = [round((when - begin_s) / TIME_BASE) for when in at_s]
    with av.open(str(out), "w") as container:
        video: Any = container.add_stream("libx264", rate=16, options={**X264, "crf": "14"})
        video.height, video.width = pictures[0].shape[:2]
        video.time_base = video.codec_context.time_base = TIME_BASE
        audio: Any = container.add_stream("aac", rate=rate, layout="mono")
        audio.bit_rate = 192_000
        add_pictures(container, video, (pictures[n] for n in shown), ticks, TIME_BASE)
        played = whole[round(begin_s * rate) :].astype(np.float32)[None]
        frame = av.AudioFrame.from_ndarray(played, format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = rate, 0, Fraction(1, rate)
        container.mux(audio.encode(frame))
        container.mux(audio.encode(None))
    return shown


def _decoded(source: Path) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, int]:
    """Times and pictures of a clip, and its sound from the time 0 with its rate."""
    with av.open(str(source)) as container:
        frames = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    with av.open(str(source)) as container:
        stream = container.streams.audio[0]
        parts = [(frame.time, frame.to_ndarray()) for frame in container.decode(audio=0)]
        heard = np.concatenate([part for _, part in parts], axis=1).mean(axis=0)
        lead = round(parts[0][0] * stream.rate)
        heard = np.concatenate([np.zeros(max(lead, 0)), heard[max(-lead, 0) :]])
    return np.array([time for time, _ in frames]), [rgb for _, rgb in frames], heard, stream.rate
