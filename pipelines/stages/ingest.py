"""Stage `ingest`: raw files to frames with their times, sound and motion energies."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.sync import synchronise
from devrf.capture.colour.srgb import linear_from_srgb
from devrf.capture.frames import SWEEP, CameraFrames, FrameSet, sharp, some
from devrf.capture.ingest.ingest import write_frames, write_sounds
from devrf.capture.measure import Measure, noted, of_test
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import CaptureError
from devrf.capture.video.audio import Sound
from devrf.pipelines.budget.at_once import ingested_at_once
from devrf.pipelines.health.judge import carried, warns_at
from devrf.pipelines.health.left_out import left_out
from devrf.pipelines.health.light_rows import light_measures
from devrf.pipelines.inputs.capture_session import capture_session
from devrf.pipelines.stage import StageContext

RANGE_MARGIN_S = 0.5  # frames kept around capture.range_s in cameras whose clock is only known by sound yet
TRUSTED = 0.5  # confidence from which a clock limits what is kept
LEAST_LEFT = 10  # frames of a damaged clip, ...
# ... and share of what its file announces: with less it is not the clip that was filmed
LEAST_LEFT_SHARE = 0.5


def run(context: StageContext) -> None:
    """Write `ingest.json`, `frames/`, `audio/` and `motion/`."""
    session = capture_session(context.config, context.scene_dir)
    context.progress(0.0, "sound")
    sounds = write_sounds(session, context.out)
    ranges = file_ranges(session, sounds, context.config.calibration.sync.method)
    clocks_known = ranges.keys() >= session.cameras.keys() - set(session.test_names)
    frames = write_frames(
        session,
        sounds,
        context.out,
        context.scene_dir,
        ranges,
        ranges if clocks_known else (),
        context.progress,
        ingested_at_once(context, session),
    )
    refuse_damaged(frames)
    context.measures += ingested(frames)
    context.measures += light_measures(frames, context.out)


def refuse_damaged(frames: FrameSet) -> None:
    """A clip whose end is damaged or missing is used as far as it goes, if that is most of what was filmed.

    Raises:
        CaptureError: Naming each file of which too little is left, where it ends and what to do.
    """
    damaged = [
        f"{name}: {camera.source} {camera.ended_early}: too little is left; copy it from the camera again, or record "
        "it again"
        for name, camera in frames.cameras.items()
        if camera.ended_early is not None
        and camera.role != "test"
        and camera.frames[-1].index + 1 < max(LEAST_LEFT, LEAST_LEFT_SHARE * (camera.announced_frames or 0))
    ]
    if damaged:
        raise CaptureError("clip-too-damaged", "\n".join(damaged))


def file_ranges(
    session: CaptureSession, sounds: dict[str, Sound], method: str
) -> dict[str, tuple[float, float]]:
    """`capture.range_s` in each camera's own times, as far as that is known before the clocks are.

    Cameras whose clocks cannot be had from sound are left out: all their frames are kept, and the scene
    stage cuts them to the range by their final times. Test cameras are heard against the others, one by one.
    """
    if session.range_s is None or not session.cameras:
        return {}
    names, (from_s, to_s) = list(session.cameras), session.range_s
    if session.timestamps is not None or method == "none":
        return dict.fromkeys(names, session.range_s)
    ranges = {names[0]: session.range_s}
    heard = [name for name in names if name in sounds]
    if method not in ("auto", "audio") or len(heard) < 2 or heard[0] != names[0]:
        return ranges
    spans = {name: (sounds[name].start_s, sounds[name].end_s) for name in heard}
    trained = {name: span for name, span in spans.items() if name not in session.test_names}
    clocks = synchronise(trained, sounds, {}, "audio").cameras
    for test in (name for name in heard if name not in trained):
        alone = trained | {test: spans[test]}
        clocks[test] = synchronise(alone, sounds, {}, "audio", extras=Extras(known=clocks)).cameras[test]
    for name, clock in clocks.items():
        if name != names[0] and clock.confidence >= TRUSTED:
            ranges[name] = (
                clock.file_time(from_s) - RANGE_MARGIN_S,
                clock.file_time(to_s) + RANGE_MARGIN_S,
            )
    return ranges


def ingested(frames: FrameSet) -> Iterator[Measure]:
    """The sweep, the moving cameras and what they have in common, and what is odd about single clips."""
    if SWEEP in frames.cameras:
        yield from _sweep(frames.cameras[SWEEP])
    if frames.trained:
        yield from _filmed(frames.trained)
        yield _exposure(frames.trained)
    for name, camera in frames.tests.items():
        yield from of_test(name, _filmed({name: camera}))
    for name, why in frames.left_out.items():
        yield left_out(name, why)
    odd = frames.without_lens
    for name, camera in frames.cameras.items():
        source = {"source": camera.source}
        if camera.ended_early is not None:
            yield Measure("not-used", camera.ended_early, name, "ended", source)
        for fault in camera.faults:
            refuses = camera.role != "test" and name not in odd
            yield replace(fault, about=name, facts={**fault.facts, **source}, refuses=refuses)
        yield from noted(camera.notes, name)


def _sweep(sweep: CameraFrames) -> Iterator[Measure]:
    is_sharp = sharp([frame.sharpness for frame in sweep.used])
    blurred = [frame.place for frame, ok in zip(sweep.used, is_sharp, strict=True) if not ok]
    facts = {
        "source": sweep.source,
        "blurred": len(blurred),
        "count": len(is_sharp),
        "places": some(blurred),
    }
    yield Measure("sweep-few-pictures", len(sweep.used))
    refuses = int(is_sharp.sum()) < warns_at("sweep-few-pictures")
    yield Measure("sweep-blurred", float(is_sharp.mean()), facts=facts, refuses=refuses)
    for text in sweep.notes:
        if text.startswith("mixed sizes"):
            yield Measure("not-used", text, "sweep", "sizes", {"source": sweep.source})


def _filmed(cameras: dict[str, CameraFrames]) -> Iterator[Measure]:
    counts = {name: len(camera.used) for name, camera in cameras.items()}
    fewest = min(counts, key=lambda name: counts[name])
    refuses, facts = not carried("clip-short", counts.values()), {"source": cameras[fewest].source}
    yield Measure("clip-short", counts[fewest], fewest, facts=facts, refuses=refuses)
    gaps = {name: c.missing_frames / (len(c.frames) + c.missing_frames) for name, c in cameras.items()}
    worst = max(gaps, key=lambda name: gaps[name])
    lost = next((text for text in cameras[worst].notes if "frames missing" in text), "frames are missing")
    facts = {"source": cameras[worst].source, "lost": lost}
    refuses = not carried("frames-dropped", gaps.values())
    yield Measure("frames-dropped", gaps[worst], worst, facts=facts, refuses=refuses)


def _exposure(cameras: dict[str, CameraFrames]) -> Measure:
    """Spread of the median brightness between cameras, in stops: views differ a little, settings a lot."""
    stops = {
        name: math.log2(max(1e-3, float(linear_from_srgb(np.array(c.level / 255)))))
        for name, c in cameras.items()
        if c.level is not None
    }
    dark, bright = (f(stops, key=lambda name: stops[name]) for f in (min, max))
    return Measure("exposure-differs", stops[bright] - stops[dark], f"{bright} against {dark}")
