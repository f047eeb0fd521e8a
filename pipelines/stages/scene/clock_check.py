"""Clocks against geometry, once cameras are known: reads pictures, calls the check, writes and says what it found."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.epipolar_motion import TimedPictures
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.geometry import (
    SHIFT_FRAMES,
    SHIFT_SIGMAS,
    GeometryCheck,
    check_clocks,
    guess_std_s,
    refined,
)
from devrf.calibration.clocks.spans import most_together
from devrf.calibration.rigs.rig import Rig
from devrf.capture.camera import Camera
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.ingest.ingest import read_motion
from devrf.capture.ingest.survey import small
from devrf.capture.measure import ENOUGH_CAMERAS, Measure, of_test
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.durable import write_json
from devrf.capture.system.progress import Progress, part
from devrf.pipelines.health.clock_rows import (
    BY_TRACKING,
    REFUSED_BELOW,
    UNSURE_FRAMES,
    confidence_measure,
    frame_ms,
)
from devrf.pipelines.run_folder.clocks import clock_dict, curve_dict, read_clocks, read_contradictions
from devrf.pipelines.stage import StageContext

SIDE_PX = 480  # of the longer side: descriptors still find cloth and skin, tracking takes milliseconds
MOST_FRAMES = 96  # of each camera, where most moves: more do not make the minimum sharper, only slower
MIN_FRAMES = 12
UNKNOWN_FRAMES = 3.0  # standard deviation of a clock by geometry that is worth a refusal


def checked_clocks(context: StageContext, frames: FrameSet, rig: Rig) -> dict[str, Clock]:
    """The moving cameras' clocks: what `sync` found, checked by geometry and replaced where that is surer.

    Those of test cameras come after, each against the others, which stand.
    """
    if len(frames.moving) < 2:
        return read_clocks(context.run_dir) if frames.moving else {}
    ingest, said = context.run_dir / "ingest", read_clocks(context.run_dir)
    cameras = {name: camera.camera for name, camera in rig.cameras.items()}
    motion, contradictions = read_motion(ingest, frames), read_contradictions(context.run_dir)
    parts = 1 + len(frames.tests)

    def check(
        n: int, asked: Mapping[str, CameraFrames], clocks: Mapping[str, Clock], test: str | None = None
    ) -> tuple[dict[str, Clock], list[Measure], dict[str, Any]]:
        views, known = timed_pictures(ingest, asked, cameras, clocks, motion), frames.trained if test else ()
        progress = part(context.progress, 0.4 * n / parts, 0.4 / parts)
        return clock_check(views, asked, clocks, progress, known, contradictions.get(test))

    clocks = {name: said[name] for name in frames.trained}
    content: dict[str, Any] = {}
    if len(clocks) > 1:
        clocks, measured, content = check(0, frames.trained, clocks)
        context.measures += measured
    content = content or {"cameras": {name: clock_dict(clock) for name, clock in clocks.items()}}
    content["tests"] = {}
    for n, (name, camera) in enumerate(frames.tests.items()):
        alone = {one: clocks[one] for one in frames.trained} | {name: said[name]}
        found, measured, told = check(n + 1, frames.trained | {name: camera}, alone, name)
        clocks[name] = found[name]
        content["cameras"][name] = clock_dict(found[name])
        content["tests"][name] = {key: value for key, value in told.items() if key != "cameras"}
        context.measures += of_test(name, measured)
    write_json(context.out / "clock_check.json", content, indent=None)
    return clocks


def timed_pictures(
    folder: Path,
    frames: Mapping[str, CameraFrames],
    cameras: Mapping[str, Camera],
    clocks: Mapping[str, Clock],
    motion: Mapping[str, Float[np.ndarray, "_ 2"]],
) -> dict[str, TimedPictures]:
    """Pictures of the cameras with their times by the clocks, from the span in which most moves.

    Cameras with too few pictures in that span are left out, and those that film when the others do not.
    """
    shown = {n: c.filmed(folder) for n, c in frames.items() if len(c.used) >= MIN_FRAMES}
    times = {n: clocks[n].true_time(np.array([f.time_s for f in of])) for n, of in shown.items()}
    times = {n: times[n] for n in most_together(times, MIN_FRAMES)}
    if not times:
        return {}
    moved = {n: (clocks[n].true_time(motion[n][:, 0]), motion[n][:, 1]) for n in times if n in motion}
    from_s, to_s = _busiest(times, {n: np.column_stack(course) for n, course in moved.items()})
    views = {}
    for name, time_s in times.items():
        inside = np.flatnonzero((time_s >= from_s) & (time_s <= to_s))
        if len(inside) >= MIN_FRAMES:
            grey = np.stack([small(read_grey(shown[name][i].file), SIDE_PX) for i in inside])
            views[name] = TimedPictures(cameras[name], grey, time_s[inside])
    return views


def clock_check(
    views: Mapping[str, TimedPictures],
    frames: Mapping[str, CameraFrames],
    clocks: Mapping[str, Clock],
    progress: Progress,
    known: Collection[str] = (),
    loop_s: float | None = None,
) -> tuple[dict[str, Clock], list[Measure], dict[str, Any]]:
    """The clocks to be used, what was measured of them, and the content of `clock_check.json`.

    `views`: `timed_pictures` by these clocks; `known`: cameras whose clocks stand, which the others are checked
    against; `loop_s`: `check_clocks`.
    """
    if len(views) < 2 or views.keys() <= set(known):
        asked = {n: c for n, c in clocks.items() if n not in known}
        return dict(clocks), unknown_clocks(asked, "too few pictures for geometry", frames), {}
    check = check_clocks(views, clocks, progress, known, loop_s)
    used = refined(clocks, check)
    asked = {n: c for n, c in used.items() if n not in known}
    found = [
        *check_measures(check, clocks, asked, frames),
        *unknown_clocks(asked, "; ".join(check.notes), frames),
    ]
    return used, found, _content(check, used)


def check_measures(
    check: GeometryCheck,
    clocks: Mapping[str, Clock],
    used: Mapping[str, Clock],
    frames: Mapping[str, CameraFrames],
) -> Iterator[Measure]:
    """What geometry says of the clocks that are used."""
    replaced = [n for n in used if used[n].method == "geometry"]
    if replaced:
        vague = max(replaced, key=lambda n: used[n].std_s)
        step_ms = frame_ms(frames[vague])
        yield Measure(
            "clock-vague",
            1e3 * used[vague].std_s,
            vague,
            "geometry",
            warn=UNSURE_FRAMES * step_ms,
            fail=UNKNOWN_FRAMES * step_ms,
            refuses=not untimed(used, frames),
        )
    kept = {n: c for n, c in check.corrections.items() if n not in replaced and c.sharp}
    if kept:
        worst = max(kept, key=lambda n: abs(kept[n].offset_s))
        found, cue = kept[worst], clocks[worst].method
        yield Measure(
            "clocks-disagree",
            1e3 * abs(found.offset_s),
            worst,
            "geometry",
            {"cue": cue, "offset_ms": 1e3 * found.offset_s, "mend": _mend(worst, cue, found.offset_s)},
            warn=max(SHIFT_FRAMES * frame_ms(frames[worst]), SHIFT_SIGMAS * 1e3 * found.std_s),
        )


def _mend(name: str, cue: str, offset_s: float) -> str:
    """What to change where a clock is off, by what gave it."""
    if cue == "audio":
        lag = f"calibration.sync.av_lag_s: {{{name}: {offset_s:.3f}}}"
        return f"An in-camera lag between sound and pictures is likely: set {lag}"
    if cue == "timestamps":
        return f"Add {offset_s:.3f} s to its times in capture.timestamps"
    return "Film with sound and clap a few times"


def untimed(used: Mapping[str, Clock], frames: Mapping[str, CameraFrames]) -> list[str]:
    """Cameras whose clocks are too little known, where enough others are known to go on without them."""
    lost = [n for n, clock in used.items() if _off_pictures(clock, frames[n]) > UNKNOWN_FRAMES]
    return lost if len(used) - len(lost) >= ENOUGH_CAMERAS else []


def _off_pictures(clock: Clock, camera: CameraFrames) -> float:
    """By how many pictures a clock that is no better than a guess may be off; 0 of others."""
    if clock.method == "reference" or clock.std_s == 0:  # taken as true
        return 0.0
    if clock.confidence < REFUSED_BELOW:
        return 1e3 * guess_std_s(clock) / frame_ms(camera)
    return 1e3 * clock.std_s / frame_ms(camera) if clock.method == "geometry" else 0.0


def unknown_clocks(used: Mapping[str, Clock], why: str, frames: Mapping[str, CameraFrames]) -> list[Measure]:
    """A refusal where a clock that was to be found by a cue is still not known.

    A warning where motion gave a guess that tracking can be expected to mend, which tries up to three pictures, and
    where the scene goes on without the camera.
    """
    found = {n: c for n, c in used.items() if c.method != "reference" and c.std_s > 0}  # 0: taken as true
    unknown = {n: c for n, c in found.items() if c.confidence < REFUSED_BELOW}

    off = {n: _off_pictures(clock, frames[n]) for n, clock in unknown.items()}
    worst = max(off, key=lambda n: off[n], default=None)
    if worst is None:
        return []
    hope = BY_TRACKING if off[worst] <= UNKNOWN_FRAMES else ""
    return [confidence_measure(worst, unknown[worst], why, hope, not untimed(used, frames))]


def _content(check: GeometryCheck, used: Mapping[str, Clock]) -> dict[str, Any]:
    return {
        "cameras": {name: clock_dict(clock) for name, clock in used.items()},
        "corrections": {name: asdict(c) for name, c in check.corrections.items()},
        "pairs": [curve_dict(pair) for pair in check.pairs],
        "loops": [asdict(loop) for loop in check.loops],
        "notes": list(check.notes),
    }


def _busiest(
    times: Mapping[str, Float[np.ndarray, " _"]], motion: Mapping[str, Float[np.ndarray, "_ 2"]]
) -> tuple[float, float]:
    """The span, within what these cameras all show and no more than `MOST_FRAMES` long, in which most moves."""
    from_s, to_s = max(t[0] for t in times.values()), min(t[-1] for t in times.values())
    length_s = MOST_FRAMES * min(float(np.median(np.diff(t))) for t in times.values())
    if to_s - from_s <= length_s:
        return from_s, to_s
    starts = np.arange(from_s, to_s - length_s, length_s / 8)
    moved = np.zeros(len(starts))
    for course in motion.values():
        total = np.concatenate([[0.0], np.cumsum(course[:, 1])])
        first, last = (np.searchsorted(course[:, 0], s) for s in (starts, starts + length_s))
        moved += (total[last] - total[first]) / max(total[-1], 1e-9)
    best_s = float(starts[np.argmax(moved)])
    return best_s, best_s + length_s
