"""Stage `sync`: every camera's clock, by which cue and how sure, and whether the clips overlap at all."""

import json
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.sync import Clock, Curve, SyncResult, synchronise
from devrf.capture.errors import InputError
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.capture.ingest import read_motion, read_sounds
from devrf.capture.progress import Progress
from devrf.pipelines.health import HealthRow, note, row
from devrf.pipelines.stage import StageContext

REFUSED_BELOW = 0.5  # confidence of a cue that is only just accepted
MIN_SHARED_FRAMES = 2
FEW_SHARED_FRAMES = 5
LISTED_NOTES = 2


def run(context: StageContext) -> None:
    """Write `sync.json` (clocks) and `curves.json` (the correlations they were read from)."""
    folder = context.run_dir / "ingest"
    frames = FrameSet.read(folder)
    result = _solve(frames.moving, frames, context, context.progress)
    content: dict[str, Any] = as_dict(result)
    content["shared_s"] = list(shared_span(frames.moving, result))
    joint = {n: c for n, c in frames.cameras.items() if c.role == "joint"}
    if len(joint) > 1:  # clips of their own, on a clock of their own: that of the first one
        content["joint"] = as_dict(_solve(joint, frames, context, context.progress))
    (context.out / "sync.json").write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    curves = {"curves": [_curve_dict(curve) for curve in result.curves]}
    (context.out / "curves.json").write_text(json.dumps(curves, allow_nan=False) + "\n")
    context.health.extend(health(frames.moving, result))


def _solve(
    cameras: dict[str, CameraFrames], frames: FrameSet, context: StageContext, progress: Progress
) -> SyncResult:
    folder, method = context.run_dir / "ingest", context.config.calibration.sync.method
    if method == "flash":
        raise InputError("calibration.sync.method: flash is not built yet; use auto, audio or motion")
    times = {name: used_times(camera) for name, camera in cameras.items()}
    spans = {name: (float(t[0]), float(t[-1])) for name, t in times.items()}
    only = set(cameras)
    return synchronise(
        spans,
        {n: s for n, s in read_sounds(folder, frames).items() if n in only},
        {n: m for n, m in read_motion(folder, frames).items() if n in only},
        method,
        frames.true_times and all(c.role != "joint" for c in cameras.values()),
        progress,
    )


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
        "cameras": {name: _clock_dict(clock) for name, clock in result.cameras.items()},
        "reference": next(iter(result.cameras)),
        "loop_s": result.loop_s,
        "notes": list(result.notes),
    }


def _clock_dict(clock: Clock) -> dict[str, Any]:
    return {
        "offset_s": clock.offset_s,
        "drift_ppm": clock.drift_ppm,
        "std_s": clock.std_s if math.isfinite(clock.std_s) else None,
        "method": clock.method,
        "confidence": clock.confidence,
        "basis": clock.basis,
    }


def _curve_dict(curve: Curve) -> dict[str, Any]:
    return {
        "first": curve.first,
        "second": curve.second,
        "method": curve.method,
        "delay_s": curve.delay_s,
        "quality": curve.quality,
        "accepted": curve.accepted,
        "lags_s": [round(float(x), 6) for x in curve.lags_s],
        "values": [round(float(x), 5) for x in curve.values],
    }


def health(cameras: dict[str, CameraFrames], result: SyncResult) -> list[HealthRow]:
    """Rows about how sure the clocks are and about what the clips share."""
    rows = [*_clocks(cameras, result), _overlap(cameras, result)]
    if result.notes:
        rows.append(note("how it was decided", "; ".join(result.notes)))
    return rows


def _clocks(cameras: dict[str, CameraFrames], result: SyncResult) -> list[HealthRow]:
    others = dict(list(result.cameras.items())[1:])
    if not others:
        return []
    cues = sorted({clock.method for clock in others.values()})
    if cues == ["timestamps"]:
        return [note("cue", "the table of times")]
    if all(clock.basis.startswith("the clips' own") for clock in others.values()):
        remedy = "Check that the cameras are synchronised by hardware, else clap and use method auto."
        return [note("cue", "none; the clips' own times", verdict="warn", remedy=remedy)]
    worst = min(others, key=lambda name: others[name].confidence)
    why = "; ".join([text for text in result.notes if worst in text.split(":")[0]][:LISTED_NOTES])
    rows = [
        note("cue", ", ".join(cues)),
        row(
            f"confidence, worst camera ({worst})",
            others[worst].confidence,
            "",
            warn=0.6,
            fail=REFUSED_BELOW,
            remedy=f"The clock of {worst} is not known: {why or others[worst].basis}. "
            "Film with sound and clap a few times at uneven intervals; or give capture.timestamps; or, for "
            "cameras synchronised by hardware, set calibration.sync.method to none.",
        ),
    ]
    vague = max(others, key=lambda name: others[name].std_s)
    if math.isfinite(others[vague].std_s):
        fps = cameras[vague].fps_mean or 30.0
        rows.append(
            row(
                f"standard deviation, worst camera ({vague})",
                1e3 * others[vague].std_s,
                "ms",
                warn=1e3 * 0.25 / fps,
                low_is_bad=False,
                remedy="A quarter of a frame or more is unsure: give all cameras sound, and clap.",
            )
        )
    if result.loop_s is not None:
        rows.append(
            row(
                "largest contradiction between pairs of cameras",
                1e3 * result.loop_s,
                "ms",
                warn=2.0 if cues == ["audio"] else 100.0,
                low_is_bad=False,
                remedy="Pairs of cameras disagree: clap in the middle, equally far from all cameras.",
            )
        )
    return rows


def _overlap(cameras: dict[str, CameraFrames], result: SyncResult) -> HealthRow:
    from_s, to_s = shared_span(cameras, result)
    slowest = min((c.fps_mean or 30.0) for c in cameras.values())
    spans = []
    for name, camera in cameras.items():
        t = result.cameras[name].true_time(used_times(camera))
        spans.append(f"{name}: {t[0]:.2f} to {t[-1]:.2f} s")
    return row(
        "time that all cameras show",
        to_s - from_s,
        "s",
        warn=(FEW_SHARED_FRAMES - 1) / slowest,
        fail=(MIN_SHARED_FRAMES - 1) / slowest,
        remedy=f"The clips share hardly any time ({', '.join(spans)}): start all cameras before the action, "
        "stop them after it.",
    )
