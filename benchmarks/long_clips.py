"""A simulated session that goes on for longer, its motion there and back, against itself as it is.

    devrf-pipeline simulate SESSION --scene sheet
    python -m benchmarks.long_clips SESSION OUT --seconds 60     # in the repository; an hour on a CPU

Writes what all cameras film at the same time as OUT/once, and there and back for so long as OUT/long, with claps at
times that do not repeat; runs both, and prints by how much each second of the long one is better where it moves.
Neither has masks of the truth.
"""

import json
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml
from benchmarks.script import arguments, finish
from jaxtyping import Float, Int

import devrf
from devrf.calibration.truth import read_truth
from devrf.capture.video.reader import VideoReader
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.render.sensor import ClipWriter
from devrf.lab.simulate.session.sound import SAMPLE_RATE_HZ, Microphone, clap_times, make_burst, record

CLAP_EVERY_S, CRF, FPS = 1.0, 14, 30.0
GOAL_DB = -0.5


def main() -> None:
    """Write both, run both, print and write the rows."""
    args = arguments(__doc__, "session", "out", seconds=60.0)
    shown, scored = {}, {}
    for name, seconds in (("once", 0.0), ("long", args.seconds)):
        shown[name] = loop_session(args.session, args.out / name, seconds)
        scored[name] = scores(
            devrf.run(args.out / name / "scene.yaml", until="evaluate", allow_unhealthy=True)
        )
    short = {(camera, shown["once"][camera][n]): psnr for (camera, n), (_, psnr) in scored["once"].items()}
    gains = defaultdict[int, list[float]](list)
    for (camera, n), (time_s, psnr) in scored["long"].items():
        if (picture := (camera, shown["long"][camera][n])) in short:
            gains[int(time_s)].append(psnr - short[picture])
    rows = [
        Row(f"long clips/second {second}/gain", float(np.mean(of)), "dB").at_least(GOAL_DB)
        for second, of in sorted(gains.items())
    ]
    finish("long clips", rows, args.json, session=args.session.name, seconds=args.seconds)


def loop_session(session: Path, out: Path, seconds: float) -> dict[str, list[int]]:
    """Write a session anew with clips that last so long, at least once; for each camera, which pictures are shown."""
    clocks = read_truth(session / "ground_truth.json").clocks
    scene = yaml.safe_load((session / "scene.yaml").read_text())
    scene.pop("evaluate", None)
    capture = scene["capture"]
    out.mkdir(parents=True)
    (out / "scene.yaml").write_text(yaml.safe_dump(scene | {"output": "run"}))
    for file in (capture["static"], *capture.get("board", {}).get("clips", {}).values()):
        (shutil.copytree if (session / file).is_dir() else shutil.copyfile)(session / file, out / file)
    clips = capture["cameras"] | capture["test_cameras"]
    true_s: dict[str, Float[np.ndarray, " n"]] = {}
    for name, file in clips.items():
        with VideoReader(session / file) as reader:
            true_s[name] = clocks[name].true_time(np.array([frame.time_s for frame in reader]))
    begin_s, end_s = max(times[0] for times in true_s.values()), min(times[-1] for times in true_s.values())
    length_s = end_s - begin_s
    turns = max(1, round(seconds / length_s))
    rng = np.random.default_rng(0)
    claps = clap_times(rng, round(turns * length_s / CLAP_EVERY_S) + 2, 0.0, turns * length_s)
    burst, shown = make_burst(rng), {}
    for name, file in clips.items():
        order, at_s = there_and_back(true_s[name] - begin_s, length_s, turns)
        microphone = Microphone(0.0, float(at_s[0]), 0.0, 1.0)  # its file begins with its first picture
        heard = record(rng, burst, claps, microphone, float(at_s[-1] - at_s[0]))
        shown[name] = order.tolist()
        _write(session / file, out / file, shown[name], at_s - at_s[0], heard)
    return shown


def there_and_back(
    times_s: Float[np.ndarray, " n"], length_s: float, turns: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Pictures of which times, from 0 to a length, are gone through so often, every second time back; and when."""
    inside = np.flatnonzero((times_s >= 0) & (times_s <= length_s))
    there, back = times_s[inside], length_s - times_s[inside]
    order = np.concatenate([inside if turn % 2 == 0 else inside[::-1] for turn in range(turns)])
    when = np.concatenate(
        [turn * length_s + (there if turn % 2 == 0 else back[::-1]) for turn in range(turns)]
    )
    kept = np.diff(when, prepend=-np.inf) > 1e-3  # the picture at which it turns is there once
    return order[kept], when[kept]


def scores(run: Path) -> Mapping[tuple[str, int], tuple[float, float]]:
    """Of each test picture of a run in which enough moves, its time and its PSNR where it moves."""
    views = json.loads((run / "evaluate" / "metrics.json").read_text())["per_view"]
    return {
        (view["camera"], view["index"]): (view["time_s"], view["moving"]["psnr"])
        for view in views
        if view.get("moving") is not None and view.get("time_s") is not None
    }


def _write(
    source: Path,
    out: Path,
    shown: Sequence[int],
    at_s: Float[np.ndarray, " m"],
    heard: Int[np.ndarray, " samples"],
) -> None:
    with VideoReader(source) as reader:
        pictures = [frame.rgb for frame in reader]
    height, width = pictures[0].shape[:2]
    clip = ClipWriter(out, (width, height), FPS, CRF, SAMPLE_RATE_HZ)
    clip.sound(heard)
    for n, time_s in zip(shown, at_s.tolist(), strict=True):
        clip.picture(pictures[n], time_s)
    clip.close()


if __name__ == "__main__":
    main()
