"""Stage `sync`: every camera's clock, by which cue and how sure, and whether the clips overlap at all."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.flash import Brightness
from devrf.calibration.clocks.spans import span_of
from devrf.calibration.clocks.sync import SyncResult, synchronise
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.ingest.ingest import read_brightness, read_motion, read_sounds
from devrf.capture.measure import ENOUGH_CAMERAS, Measure, noted, of_test
from devrf.capture.rest import Rest
from devrf.capture.system.durable import write_json
from devrf.capture.system.errors import CalibrationError
from devrf.capture.video.recorded import Recorded
from devrf.pipelines.health.clock_rows import (
    BY_GEOMETRY,
    REFUSED_BELOW,
    UNSURE_FRAMES,
    USUAL_FPS,
    confidence_measure,
    frame_ms,
)
from devrf.pipelines.health.left_out import left_out
from devrf.pipelines.run_folder.clocks import clock_dict, curve_dict
from devrf.pipelines.stage import StageContext

MIN_SHARED_FRAMES = 2
FEW_SHARED_FRAMES = 5
LISTED_NOTES = 2
WRONG_RATE_PPM = 200.0  # no quartz is that far off; 29.97 declared as 30 is 1000


def run(context: StageContext) -> None:
    """Write `sync.json` (clocks) and `curves.json` (the correlations they were read from)."""
    folder = context.run_dir / "ingest"
    frames = FrameSet.read(folder)
    job = _Job(context, frames)
    result = job.solve(frames.trained)
    content: dict[str, Any] = as_dict(result)
    content["shared_s"] = list(shared_span(frames.trained, result))
    context.measures += measures(frames.trained, result)
    curves = _evidence(result)
    curves["tests"], content["tests"] = {}, {}
    for name, camera in frames.tests.items():  # each against those that stand
        alone = frames.trained | {name: camera}
        placed = job.place(name, alone, result)
        content["cameras"][name] = clock_dict(placed.cameras[name])
        content["tests"][name] = {"loop_s": placed.loop_s, "notes": list(placed.notes)}
        curves["tests"][name] = _evidence(placed)
        context.measures += test_measures(name, alone, placed, result)
    joint = {n: c for n, c in frames.cameras.items() if c.role == "joint"}
    tests = {frames.joint[n] for n in frames.tests if n in frames.joint} & joint.keys()
    trained = {n: c for n, c in joint.items() if n not in tests}
    if len(trained) > 1:  # clips of their own, on a clock of their own: that of the first one
        together = job.solve(trained, "none")
        content["joint"] = as_dict(together)
        for name in sorted(tests):
            placed = job.place(name, trained | {name: joint[name]}, together, "none")
            content["joint"]["cameras"][name] = clock_dict(placed.cameras[name])
    write_json(context.out / "sync.json", content)
    write_json(context.out / "curves.json", curves, indent=None)


def recorded(cameras: Mapping[str, CameraFrames]) -> dict[str, Recorded]:
    """What the files say of when they begin."""
    return {n: Recorded(c.created_s, c.timecode_s, c.timecode_fps) for n, c in cameras.items()}


class _Job:
    """What cameras heard and saw, as ingest left it, and how clocks are found from it."""

    def __init__(self, context: StageContext, frames: FrameSet) -> None:
        folder = context.run_dir / "ingest"
        self.context, self.frames = context, frames
        self.config = context.config.calibration.sync
        self.brightness = {
            n: Brightness(b[:, 0], b[:, 1:]) for n, b in read_brightness(folder, frames).items() if len(b) > 1
        }
        self.sounds, self.motion = read_sounds(folder, frames), read_motion(folder, frames)

    def solve(
        self,
        cameras: dict[str, CameraFrames],
        rest: Rest | None = None,
        known: Mapping[str, Clock] | None = None,
    ) -> SyncResult:
        """The clocks of these cameras; those that are `known` stand."""
        times = {name: used_times(camera) for name, camera in cameras.items()}
        extras = Extras(
            {n: b for n, b in self.brightness.items() if n in cameras},
            recorded(cameras),
            self.config.av_lag_s,
            self.config.readout_s,
            rest or self.context.config.rest,
            self.frames.true_times and all(c.role != "joint" for c in cameras.values()),
            known or {},
        )
        return synchronise(
            {name: (float(t[0]), float(t[-1])) for name, t in times.items()},
            {n: s for n, s in self.sounds.items() if n in cameras},
            {n: m for n, m in self.motion.items() if n in cameras},
            self.config.method,
            self.context.progress,
            extras,
        )

    def place(
        self, name: str, cameras: dict[str, CameraFrames], others: SyncResult, rest: Rest | None = None
    ) -> SyncResult:
        """A test camera on the clock of others, which stand; where the cue that is asked for has none, a guess."""
        try:
            return self.solve(cameras, rest, others.cameras)
        except CalibrationError as error:
            clock = Clock(0.0, 0.0, math.inf, "none", 0.0, str(error))
            return SyncResult(others.cameras | {name: clock}, notes=(str(error),))


def used_times(camera: CameraFrames) -> Float[np.ndarray, " n"]:
    """File times of the frames that are used [n], seconds."""
    return np.array([frame.time_s for frame in camera.used if frame.time_s is not None])


def shared_span(cameras: dict[str, CameraFrames], result: SyncResult) -> tuple[float, float]:
    """What all cameras show, on the first one's clock, seconds; the end comes first where nothing is."""
    spans = {name: result.cameras[name].true_time(used_times(c))[[0, -1]] for name, c in cameras.items()}
    return float(max(s[0] for s in spans.values())), float(min(s[1] for s in spans.values()))


def as_dict(result: SyncResult) -> dict[str, Any]:
    """A result as it is written to `sync.json`."""
    return {
        "cameras": {name: clock_dict(clock) for name, clock in result.cameras.items()},
        "reference": next(iter(result.cameras)),
        "loop_s": result.loop_s,
        "notes": list(result.notes),
    }


def _evidence(result: SyncResult) -> dict[str, Any]:
    """What clocks were read from, as it is written to `curves.json`."""
    return {
        "curves": [curve_dict(curve) for curve in result.curves],
        "loops": [asdict(loop) for loop in result.loops],
        "comparisons": [asdict(c) | {"contradicts": c.contradicts} for c in result.comparisons],
    }


def measures(cameras: dict[str, CameraFrames], result: SyncResult) -> list[Measure]:
    """How sure the clocks are, and what the clips share."""
    found = [*_clocks(cameras, result), *_cues(result), *_rates(cameras, result), _overlap(cameras, result)]
    return [*found, *noted(result.notes, "clocks")]


def test_measures(
    name: str, cameras: dict[str, CameraFrames], placed: SyncResult, others: SyncResult
) -> list[Measure]:
    """The clock of a test camera, which refuses nothing; `others`: the clocks that stand."""
    alone = replace(placed, cameras={n: c for n, c in placed.cameras.items() if n not in others.cameras})
    times = alone.cameras[name].true_time(used_times(cameras[name]))
    found = [*_clocks(cameras, alone), *_cues(placed)]
    modelled = _modelled(cameras, {n: placed.cameras[n].true_time(used_times(c)) for n, c in cameras.items()})
    if modelled is not None and not ((times >= modelled[0]) & (times <= modelled[1])).any():
        why = (
            f"it films from {times[0]:.2f} to {times[-1]:.2f} s, and what is modelled lasts from {modelled[0]:.2f} to "
            f"{modelled[1]:.2f} s"
        )
        found.append(left_out(name, why))
    return of_test(name, found)


def _clocks(cameras: dict[str, CameraFrames], result: SyncResult) -> Iterator[Measure]:
    others = {name: clock for name, clock in result.cameras.items() if name != next(iter(cameras))}
    if not others:
        return
    cues = sorted({clock.method for clock in others.values()})
    if all(clock.method == "timestamps" and clock.confidence == 1 for clock in others.values()):
        return
    if all(clock.basis.startswith("the clips' own") for clock in others.values()):
        yield Measure("clock-unknown", "no cue is used; the clips' own times", ", ".join(others), "assumed")
        return
    worst = min(others, key=lambda name: others[name].confidence)
    why = "; ".join([text for text in result.notes if worst in text.split(":")[0]][:LISTED_NOTES])
    moves = any(curve.method == "motion" and worst in (curve.first, curve.second) for curve in result.curves)
    known = 1 + sum(clock.confidence >= REFUSED_BELOW for clock in others.values())  # and the first one
    hope, refuses = BY_GEOMETRY if moves else "", known < ENOUGH_CAMERAS
    yield confidence_measure(worst, others[worst], why, hope, refuses)
    vague = max(others, key=lambda name: others[name].std_s)
    if math.isfinite(others[vague].std_s):
        step_ms = frame_ms(cameras[vague])
        warn, facts = UNSURE_FRAMES * step_ms, {"half_ms": step_ms / 2}
        yield Measure("clock-vague", 1e3 * others[vague].std_s, vague, facts=facts, warn=warn)
    if result.loop_s is not None:
        warn, facts = 2.0 if cues == ["audio"] else 100.0, {"loop": _worst_loop(result)}
        yield Measure("clocks-disagree", 1e3 * result.loop_s, "", "loop", facts, warn=warn)


def _worst_loop(result: SyncResult) -> str:
    if not result.loops:
        return "Pairs of cameras disagree"
    loop = max(result.loops, key=lambda found: abs(found.closure_s))
    return f"The loop {' - '.join(loop.cameras)} does not close, {1e3 * abs(loop.closure_s):.0f} ms are left"


def _cues(result: SyncResult) -> Iterator[Measure]:
    """Independent cues against each other."""
    for other in dict.fromkeys(c.other for c in result.comparisons):
        pairs = [c for c in result.comparisons if c.other == other]
        worst = max(pairs, key=lambda c: abs(c.difference_s) / c.limit_s)
        facts = {
            "names": f"{worst.first} and {worst.second}",
            "cue": other,
            "difference_ms": 1e3 * worst.difference_s,
            "difference_s": worst.difference_s,
            "second": worst.second,
        }
        about, value_ms = f"{other} against sound, {facts['names']}", 1e3 * abs(worst.difference_s)
        yield Measure("clocks-disagree", value_ms, about, "cue", facts, warn=1e3 * worst.limit_s)


def _rates(cameras: dict[str, CameraFrames], result: SyncResult) -> Iterator[Measure]:
    """A clock that runs at another rate than any quartz does."""
    drifts = {name: clock.drift_ppm for name, clock in result.cameras.items() if clock.drift_ppm}
    worst = max(drifts, key=lambda name: abs(drifts[name]), default="")
    if worst and abs(drifts[worst]) > WRONG_RATE_PPM:
        t = used_times(cameras[worst])
        over_ms = 1e-3 * drifts[worst] * (t[-1] - t[0])
        text = f"{worst} {drifts[worst]:+.0f} ppm: {over_ms:+.1f} ms over its clip; counted"
        yield Measure("clip-times", text, worst, "rate")


def _overlap(cameras: dict[str, CameraFrames], result: SyncResult) -> Measure:
    """What all cameras show; refused only where that leaves no time to model."""
    from_s, to_s = shared_span(cameras, result)
    times = {name: result.cameras[name].true_time(used_times(c)) for name, c in cameras.items()}
    modelled, apart = _modelled(cameras, times), []
    facts = {"spans": ", ".join(f"{name}: {t[0]:.2f} to {t[-1]:.2f} s" for name, t in times.items())}
    if modelled is not None:
        begin, end = modelled
        apart = [name for name, t in times.items() if not ((t >= begin) & (t <= end)).any()]
        facts |= {"apart": ", ".join(apart), "begin_s": begin, "end_s": end}
    slowest = min((c.fps_mean or USUAL_FPS) for c in cameras.values())
    return Measure(
        "cameras-apart",
        to_s - from_s,
        why="unused" if apart else "",
        facts=facts,
        warn=(FEW_SHARED_FRAMES - 1) / slowest,
        fail=(MIN_SHARED_FRAMES - 1) / slowest if modelled is None else None,
    )


def _modelled(
    cameras: dict[str, CameraFrames], times: Mapping[str, Float[np.ndarray, " _"]]
) -> tuple[float, float] | None:
    """What will be modelled, seconds; None where it is too short for two frames of any training camera."""
    taught = [name for name, camera in cameras.items() if camera.role != "test"]
    span = span_of([(float(times[name][0]), float(times[name][-1])) for name in taught])
    fastest = max((cameras[name].fps_mean or USUAL_FPS for name in taught), default=USUAL_FPS)
    return span if span is not None and span[1] - span[0] >= (MIN_SHARED_FRAMES - 1) / fastest else None
