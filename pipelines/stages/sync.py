"""Stage `sync`: every camera's clock, by which cue and how sure, and whether the clips overlap at all."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.clocks.evidence import Curve, Extras
from devrf.calibration.clocks.flash import Brightness
from devrf.calibration.clocks.spans import span_of
from devrf.calibration.clocks.sync import SyncResult, synchronise
from devrf.capture.errors import CalibrationError
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.ingest import read_brightness, read_motion, read_sounds
from devrf.capture.recorded import Recorded
from devrf.capture.rest import Rest
from devrf.pipelines.clocks import clock_dict, curve_dict
from devrf.pipelines.health.clock import BY_GEOMETRY, UNSURE_FRAMES, USUAL_FPS, confidence_row, frame_ms
from devrf.pipelines.health.rows import HealthRow, left_out_row, note, of_test, row, without_refusal
from devrf.pipelines.stage import StageContext

MIN_SHARED_FRAMES = 2
FEW_SHARED_FRAMES = 5
LISTED_NOTES = 2
WRONG_RATE_PPM = 200.0  # no quartz is that far off; 29.97 declared as 30 is 1000
DIFFERENT_FPS = 1.02


def run(context: StageContext) -> None:
    """Write `sync.json` (clocks) and `curves.json` (the correlations they were read from)."""
    folder = context.run_dir / "ingest"
    frames = FrameSet.read(folder)
    capture = context.config.capture
    rest: Rest = capture.rest if capture else "none"
    job = _Job(context, frames, rest)
    result = job.solve(frames.trained)
    content: dict[str, Any] = as_dict(result)
    content["shared_s"] = list(shared_span(frames.trained, result))
    context.health.extend(health(frames.trained, result))
    curves = _evidence(result)
    curves["tests"], content["tests"] = {}, {}
    for name, camera in frames.tests.items():  # each against those that stand
        alone = frames.trained | {name: camera}
        placed = job.place(name, alone, result)
        content["cameras"][name] = clock_dict(placed.cameras[name])
        content["tests"][name] = {"loop_s": placed.loop_s, "notes": list(placed.notes)}
        curves["tests"][name] = _evidence(placed)
        context.health.extend(test_health(name, alone, placed, result))
    joint = {n: c for n, c in frames.cameras.items() if c.role == "joint"}
    tests = {frames.joint[n] for n in frames.tests if n in frames.joint} & joint.keys()
    trained = {n: c for n, c in joint.items() if n not in tests}
    if len(trained) > 1:  # clips of their own, on a clock of their own: that of the first one
        together = job.solve(trained, "none")
        content["joint"] = as_dict(together)
        for name in sorted(tests):
            placed = job.place(name, trained | {name: joint[name]}, together, "none")
            content["joint"]["cameras"][name] = clock_dict(placed.cameras[name])
    (context.out / "sync.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    (context.out / "curves.json").write_text(json.dumps(curves, allow_nan=False) + "\n")


def recorded(cameras: Mapping[str, CameraFrames]) -> dict[str, Recorded]:
    """What the files say of when they begin."""
    return {n: Recorded(c.created_s, c.timecode_s, c.timecode_fps) for n, c in cameras.items()}


class _Job:
    """What cameras heard and saw, as ingest left it, and how clocks are found from it."""

    def __init__(self, context: StageContext, frames: FrameSet, rest: Rest) -> None:
        folder = context.run_dir / "ingest"
        self.context, self.frames = context, frames
        self.rest: Rest = rest
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
            rest or self.rest,
        )
        return synchronise(
            {name: (float(t[0]), float(t[-1])) for name, t in times.items()},
            {n: s for n, s in self.sounds.items() if n in cameras},
            {n: m for n, m in self.motion.items() if n in cameras},
            self.config.method,
            self.frames.true_times and all(c.role != "joint" for c in cameras.values()),
            self.context.progress,
            extras,
            known,
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
        "curves": [_curve_dict(curve) for curve in result.curves],
        "loops": [asdict(loop) for loop in result.loops],
        "comparisons": [asdict(c) | {"contradicts": c.contradicts} for c in result.comparisons],
    }


def _curve_dict(curve: Curve) -> dict[str, Any]:
    return {
        "first": curve.first,
        "second": curve.second,
        "method": curve.method,
        "delay_s": curve.delay_s,
        "quality": curve.quality,
        "accepted": curve.accepted,
    } | curve_dict(curve.lags_s, curve.values)


def health(cameras: dict[str, CameraFrames], result: SyncResult) -> list[HealthRow]:
    """Rows about how sure the clocks are and about what the clips share."""
    rows = [*_clocks(cameras, result), *_cues(result), *_rates(cameras, result), _overlap(cameras, result)]
    if result.notes:
        rows.append(note("how it was decided", "; ".join(result.notes)))
    return rows


def test_health(
    name: str, cameras: dict[str, CameraFrames], placed: SyncResult, others: SyncResult
) -> list[HealthRow]:
    """Rows about the clock of a test camera, which refuse nothing; `others`: the clocks that stand."""
    alone = replace(placed, cameras={n: c for n, c in placed.cameras.items() if n not in others.cameras})
    times = alone.cameras[name].true_time(used_times(cameras[name]))
    rows = [*_clocks(cameras, alone), *_cues(placed)]
    modelled = _modelled(cameras, {n: placed.cameras[n].true_time(used_times(c)) for n, c in cameras.items()})
    if modelled is not None and not ((times >= modelled[0]) & (times <= modelled[1])).any():
        why = (
            f"it films from {times[0]:.2f} to {times[-1]:.2f} s, and what is modelled lasts from {modelled[0]:.2f} to "
            f"{modelled[1]:.2f} s"
        )
        rows.append(left_out_row(name, why))
    return without_refusal(of_test(name, rows))


def _clocks(cameras: dict[str, CameraFrames], result: SyncResult) -> Iterator[HealthRow]:
    others = {name: clock for name, clock in result.cameras.items() if name != next(iter(cameras))}
    if not others:
        return
    cues = sorted({clock.method for clock in others.values()})
    if all(clock.method == "timestamps" and clock.confidence == 1 for clock in others.values()):
        yield note("cue", "the table of times")
        return
    if all(clock.basis.startswith("the clips' own") for clock in others.values()):
        remedy = "Check that the cameras are synchronised by hardware, else clap and use method auto."
        yield note("cue", "none; the clips' own times", remedy=remedy)
        return
    worst = min(others, key=lambda name: others[name].confidence)
    why = "; ".join([text for text in result.notes if worst in text.split(":")[0]][:LISTED_NOTES])
    moves = any(curve.method == "motion" and worst in (curve.first, curve.second) for curve in result.curves)
    yield note("cue", ", ".join(cues))
    yield confidence_row(worst, others[worst], why, BY_GEOMETRY if moves else "")
    vague = max(others, key=lambda name: others[name].std_s)
    if math.isfinite(others[vague].std_s):
        step_ms = frame_ms(cameras[vague])
        yield row(
            f"standard deviation, worst camera ({vague})",
            1e3 * others[vague].std_s,
            "ms",
            warn_above=UNSURE_FRAMES * step_ms,
            remedy="A quarter of a frame or more is unsure, and shifting whole frames would add up to "
            f"{step_ms / 2:.0f} ms: give all cameras sound, and clap.",
        )
    if result.loop_s is not None:
        yield row(
            "largest contradiction between pairs of cameras",
            1e3 * result.loop_s,
            "ms",
            warn_above=2.0 if cues == ["audio"] else 100.0,
            remedy=f"{_worst_loop(result)}: clap in the middle, equally far from all cameras.",
        )


def _worst_loop(result: SyncResult) -> str:
    if not result.loops:
        return "Pairs of cameras disagree"
    loop = max(result.loops, key=lambda found: abs(found.closure_s))
    return f"The loop {' - '.join(loop.cameras)} does not close, {1e3 * abs(loop.closure_s):.0f} ms are left"


def _cues(result: SyncResult) -> Iterator[HealthRow]:
    """Independent cues against each other."""
    for other in dict.fromkeys(c.other for c in result.comparisons):
        pairs = [c for c in result.comparisons if c.other == other]
        worst = max(pairs, key=lambda c: abs(c.difference_s) / c.limit_s)
        names = f"{worst.first} and {worst.second}"
        yield row(
            f"{other} against sound, {names}",
            1e3 * abs(worst.difference_s),
            "ms",
            warn_above=1e3 * worst.limit_s,
            remedy=f"{names}: {other} and sound differ by {1e3 * worst.difference_s:+.0f} ms. If it is the same "
            "in every take, it is the camera's lag between sound and pictures: set calibration.sync.av_lag_s: "
            f"{{{worst.second}: {worst.difference_s:.3f}}}. Else film a clap that the cameras also see.",
        )


def _rates(cameras: dict[str, CameraFrames], result: SyncResult) -> Iterator[HealthRow]:
    """Clocks that run at different rates, and cameras that take different numbers of pictures."""
    drifts = {name: clock.drift_ppm for name, clock in result.cameras.items() if clock.drift_ppm}
    if drifts:
        worst = max(drifts, key=lambda name: abs(drifts[name]))
        t = used_times(cameras[worst])
        over_ms = 1e-3 * drifts[worst] * (t[-1] - t[0])
        value = f"{worst} {drifts[worst]:+.0f} ppm: {over_ms:+.1f} ms over its clip; counted"
        wrong_base = abs(drifts[worst]) > WRONG_RATE_PPM
        yield note(
            "drift",
            value,
            remedy=f"{worst}'s file declares a wrong rate (29.97 declared as 30 is 1000 ppm): its times are "
            "stretched to fit; copy the original file from the camera, without conversion."
            if wrong_base
            else "",
        )
    rates = {name: c.fps_mean for name, c in cameras.items() if c.fps_mean}
    if rates and max(rates.values()) > DIFFERENT_FPS * min(rates.values()):
        text = ", ".join(f"{name} {fps:.4g} fps" for name, fps in rates.items())
        yield note("frame rates", f"{text}; frames keep their own times")


def _overlap(cameras: dict[str, CameraFrames], result: SyncResult) -> HealthRow:
    """What all cameras show; refused only where that leaves no time to model."""
    from_s, to_s = shared_span(cameras, result)
    times = {name: result.cameras[name].true_time(used_times(c)) for name, c in cameras.items()}
    spans = ", ".join(f"{name}: {t[0]:.2f} to {t[-1]:.2f} s" for name, t in times.items())
    together = "start all cameras before the action, stop them after it"
    remedy = f"The clips share hardly any time ({spans}): {together}."
    modelled = _modelled(cameras, times)
    if modelled is not None:
        begin, end = modelled
        apart = [name for name, t in times.items() if not ((t >= begin) & (t <= end)).any()]
        if apart:
            remedy = (
                f"Nothing of {', '.join(apart)} is used: the training cameras film together from {begin:.2f} to "
                f"{end:.2f} s, and only that is modelled ({spans}): {together}, or check the clocks."
            )
    slowest = min((c.fps_mean or USUAL_FPS) for c in cameras.values())
    return row(
        "time that all cameras show",
        to_s - from_s,
        "s",
        warn=(FEW_SHARED_FRAMES - 1) / slowest,
        fail=(MIN_SHARED_FRAMES - 1) / slowest if modelled is None else None,
        remedy=remedy,
    )


def _modelled(
    cameras: dict[str, CameraFrames], times: Mapping[str, Float[np.ndarray, " _"]]
) -> tuple[float, float] | None:
    """What will be modelled, seconds; None where it is too short for two frames of any training camera."""
    taught = [name for name, camera in cameras.items() if camera.role != "test"]
    span = span_of([(float(times[name][0]), float(times[name][-1])) for name in taught])
    fastest = max((cameras[name].fps_mean or USUAL_FPS for name in taught), default=USUAL_FPS)
    return span if span is not None and span[1] - span[0] >= (MIN_SHARED_FRAMES - 1) / fastest else None
