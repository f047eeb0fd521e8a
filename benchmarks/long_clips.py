"""A simulated session that goes on for longer, its motion there and back, against itself as it is.

    devrf-pipeline simulate SESSION --scene sheet --seed 0
    python -m benchmarks.long_clips SESSION OUT --seconds 60     # from the repository's root; hours on a CPU

Writes what all cameras film at the same time as OUT/once, and again and again as OUT/long, with noise of its own for
sound, since claps that repeat fit at many delays; runs both, and prints by how much each second of the long one is
better or worse where it moves. Neither has masks of the truth.
"""

import json
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml
from benchmarks.script import arguments, finish
from jaxtyping import Float
from tests.make.clips import TIME_BASE, add_pictures

from devrf.capture.video.video_writer import X264
from devrf.lab.bench.bench_rows import Row

RATE_HZ = 48_000
BURSTS_HZ, BURST_S = 2.0, 0.03  # of noise
GOAL_DB = -0.5


def main() -> None:
    """Write both, run both, print and write the rows."""
    args = arguments(__doc__, "session", "out", seconds=60.0)
    once, shown = (
        loop_session(args.session, args.out / name, seconds)["witness"]
        for name, seconds in (("once", 0.0), ("long", args.seconds))
    )
    for name in ("once", "long"):
        run = [
            sys.executable,
            "-m",
            "devrf",
            "run",
            str(args.out / name / "scene.yaml"),
            "--set",
            "output=run",
        ]
        subprocess.run([*run, "--until", "evaluate", "--allow-unhealthy"], check=True)
    short, long = (scores(args.out / name / "run") for name in ("once", "long"))
    apart = by_second({once[n]: of for n, of in short.items()}, long, shown)
    rows = [
        Row(f"long clips/second {second}/gain", float(np.mean(gains)), "dB").at_least(GOAL_DB)
        for second, gains in apart.items()
    ]
    finish("long clips", rows, args.json, session=args.session.name, seconds=args.seconds)


def loop_session(session: Path, out: Path, seconds: float) -> dict[str, list[int]]:
    """Write a session anew with clips that last so long, at least once; for each camera, which pictures are shown."""
    truth = json.loads((session / "ground_truth.json").read_text())["cams"]
    scene = yaml.safe_load((session / "scene.yaml").read_text())
    scene.pop("evaluate", None)
    capture = scene["capture"]
    clips = capture["cameras"] | capture["test_cameras"]
    true_s = {
        name: truth[name]["offset_s"] + (1 + 1e-6 * truth[name]["drift_ppm"]) * _times_s(session / file)
        for name, file in clips.items()
    }
    span_s = max(times[0] for times in true_s.values()), min(times[-1] for times in true_s.values())
    out.mkdir(parents=True)
    for file in (capture["static"], *capture.get("board", {}).get("clips", {}).values()):
        (shutil.copytree if (session / file).is_dir() else shutil.copyfile)(session / file, out / file)
    (out / "scene.yaml").write_text(yaml.safe_dump(scene))
    turns = max(1, round(seconds / (span_s[1] - span_s[0])))
    heard = _noise(turns * (span_s[1] - span_s[0]))
    return {
        name: _loop_clip(session / file, out / file, true_s[name], span_s, turns, heard)
        for name, file in clips.items()
    }


def scores(run: Path) -> dict[int, tuple[float, float]]:
    """Of each test picture of a run in which enough moves, its time and its PSNR where it moves."""
    views = json.loads((run / "evaluate" / "metrics.json").read_text())["per_view"]
    moving = [view for view in views if view.get("moving") is not None and view.get("time_s") is not None]
    return {view["index"]: (view["time_s"], view["moving"]["psnr"]) for view in moving}


def by_second(
    short: Mapping[int, tuple[float, float]], long: Mapping[int, tuple[float, float]], shown: Sequence[int]
) -> dict[int, list[float]]:
    """By how much pictures of each second are better than the same ones, `shown` there, of the short session."""
    out = defaultdict[int, list[float]](list)
    for n, (time_s, psnr) in sorted(long.items()):
        if shown[n] in short:
            out[int(time_s)].append(psnr - short[shown[n]][1])
    return dict(out)


def _loop_clip(
    source: Path,
    out: Path,
    true_s: Float[np.ndarray, " n"],
    span_s: tuple[float, float],
    turns: int,
    heard: Float[np.ndarray, " samples"],
) -> list[int]:
    """Write a clip that goes there and back so many times; the numbers of the pictures that are shown.

    Its file begins with its first picture, as the simulator's do, and its clock no longer drifts.
    """
    with av.open(str(source)) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    seen = np.flatnonzero((true_s >= span_s[0]) & (true_s <= span_s[1]))
    length_s = span_s[1] - span_s[0]
    shown: list[int] = []
    at_s: list[float] = []
    for turn in range(turns):
        after = true_s[seen] - span_s[0] if turn % 2 == 0 else span_s[1] - true_s[seen]
        for n in np.argsort(after):
            when = turn * length_s + float(after[n])
            if not at_s or when > at_s[-1] + 1e-3:  # the picture at which it turns is there once
                shown.append(int(seen[n]))
                at_s.append(when)
    ticks = [round((when - at_s[0]) / TIME_BASE) for when in at_s]
    with av.open(str(out), "w") as container:
        video: Any = container.add_stream("libx264", rate=30, options={**X264, "crf": "14"})
        video.height, video.width = pictures[0].shape[:2]
        video.time_base = video.codec_context.time_base = TIME_BASE
        audio: Any = container.add_stream("aac", rate=RATE_HZ)
        audio.layout = "mono"
        add_pictures(container, video, (pictures[n] for n in shown), ticks, TIME_BASE)
        played = heard[round(at_s[0] * RATE_HZ) :].astype(np.float32)[None]
        frame = av.AudioFrame.from_ndarray(played, format="fltp", layout="mono")
        frame.sample_rate, frame.pts = RATE_HZ, 0
        container.mux(audio.encode(frame))
        container.mux(audio.encode(None))
    return shown


def _times_s(clip: Path) -> Float[np.ndarray, " n"]:
    with av.open(str(clip)) as container:
        return np.array([float(frame.pts * frame.time_base) for frame in container.decode(video=0)])


def _noise(seconds: float) -> Float[np.ndarray, " samples"]:
    """Bursts of noise at times that do not repeat."""
    rng = np.random.default_rng(0)
    out = np.zeros(round((seconds + 1) * RATE_HZ))
    for begin in rng.integers(0, len(out), round(BURSTS_HZ * seconds) + 4):
        burst = out[begin : begin + round(BURST_S * RATE_HZ)]
        burst += 0.2 * rng.standard_normal(len(burst)) * np.linspace(1, 0, len(burst))
    return out.clip(-1, 1)


if __name__ == "__main__":
    main()
