"""Stage `ingest`: raw files to frames with their times, sound and motion energies."""

import math
from collections.abc import Iterator

import numpy as np

from devrf.calibration.clocks.sync import synchronise
from devrf.capture.audio import Sound
from devrf.capture.errors import CaptureError
from devrf.capture.frames import SWEEP, CameraFrames, FrameSet, places, sharp
from devrf.capture.ingest import write_frames, write_sounds
from devrf.capture.session import CaptureSession
from devrf.capture.srgb import linear_from_srgb
from devrf.pipelines.budget.raw_files import ingested_at_once
from devrf.pipelines.capture_session import capture_session
from devrf.pipelines.health.light import light_rows
from devrf.pipelines.health.rows import HealthRow, left_out_row, note, row, without_refusal
from devrf.pipelines.stage import StageContext

RANGE_MARGIN_S = 0.5  # frames kept around capture.range_s in cameras whose clock is only known by sound yet
TRUSTED = 0.5  # confidence from which a clock limits what is kept
FEWEST_SWEEP_PICTURES = 3  # with fewer nothing is registered
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
    context.health.extend(health(frames))
    context.health.extend(light_rows(frames, context.out))


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
        clocks[test] = synchronise(alone, sounds, {}, "audio", known=clocks).cameras[test]
    for name, clock in clocks.items():
        if name != names[0] and clock.confidence >= TRUSTED:
            ranges[name] = (
                clock.file_time(from_s) - RANGE_MARGIN_S,
                clock.file_time(to_s) + RANGE_MARGIN_S,
            )
    return ranges


def health(frames: FrameSet) -> list[HealthRow]:
    """Rows about the sweep, the moving cameras and what they have in common."""
    rows: list[HealthRow] = []
    if SWEEP in frames.cameras:
        rows += _sweep(frames.cameras[SWEEP])
    if frames.trained:
        rows += _moving(frames.trained)
    for name, camera in frames.tests.items():
        rows += without_refusal(_filmed({name: camera}))
    rows += [left_out_row(name, why) for name, why in frames.left_out.items()]
    for name, camera in frames.cameras.items():
        if camera.ended_early is not None:
            remedy = (
                f"{camera.source} is damaged: what is there is used, and the scene ends with it; copy the file from "
                "the camera again to have all of it."
            )
            rows.append(note(f"end of {name}", camera.ended_early, remedy=remedy))
        rows += [
            note(f"{fault.check}, {name}", fault.found, remedy=f"{camera.source}: {fault.remedy}")
            for fault in camera.faults
        ]
        if camera.notes:
            rows.append(note(name, "; ".join(camera.notes)))
    return rows


def _sweep(sweep: CameraFrames) -> Iterator[HealthRow]:
    is_sharp = sharp([frame.sharpness for frame in sweep.used])
    blurred = [frame.place for frame, ok in zip(sweep.used, is_sharp, strict=True) if not ok]
    sizes = [text for text in sweep.notes if text.startswith("mixed sizes")]
    yield row(
        "pictures of the sweep",
        float(len(sweep.used)),
        warn=20.0,
        fail=float(FEWEST_SWEEP_PICTURES),
        remedy="Film more of the scene at rest: walk around it slowly, at two or three heights.",
    )
    yield row(
        "sharp share of the sweep",
        float(is_sharp.mean()),
        warn=0.8,
        fail=0.3,
        remedy=f"{sweep.source}: {len(blurred)} of {len(is_sharp)} pictures are blurred ({places(blurred)}). Walk "
        "more slowly, or use a shorter shutter and more light.",
    )
    if sizes:
        remedy = f"{sweep.source}: keep one camera in one mode (size and orientation) for the whole sweep."
        yield note("sizes in the sweep", sizes[0], remedy=remedy)


def _filmed(cameras: dict[str, CameraFrames]) -> Iterator[HealthRow]:
    fewest = min(cameras, key=lambda name: len(cameras[name].used))
    gaps = {name: c.missing_frames / (len(c.frames) + c.missing_frames) for name, c in cameras.items()}
    worst = max(gaps, key=lambda name: gaps[name])
    yield row(
        f"frames of a moving camera, fewest ({fewest})",
        float(len(cameras[fewest].used)),
        warn=10.0,
        fail=2.0,
        remedy=f"{cameras[fewest].source} is too short: film longer, or widen capture.range_s.",
    )
    lost = next((text for text in cameras[worst].notes if "frames missing" in text), "frames are missing")
    yield row(
        f"share of frames dropped while filming, worst camera ({worst})",
        gaps[worst],
        warn_above=0.02,
        fail_above=0.5,
        remedy=f"{cameras[worst].source}: {lost}. Use a faster card, or a lower resolution or bit rate.",
    )


def _moving(cameras: dict[str, CameraFrames]) -> Iterator[HealthRow]:
    yield from _filmed(cameras)
    yield _exposure(cameras)
    silent = [name for name, c in cameras.items() if not c.has_audio]
    yield note("sound", f"silent: {', '.join(silent)}" if silent else "in every camera")
    sizes = {(c.width, c.height) for c in cameras.values()}
    if len(sizes) > 1:
        text = ", ".join(f"{name}: {c.width}x{c.height}" for name, c in cameras.items())
        yield note("sizes of the moving cameras", f"{text}; each keeps its own")


def _exposure(cameras: dict[str, CameraFrames]) -> HealthRow:
    """Spread of the median brightness between cameras, in stops: views differ a little, settings a lot."""
    stops = {
        name: math.log2(max(1e-3, float(linear_from_srgb(np.array(c.level / 255)))))
        for name, c in cameras.items()
        if c.level is not None
    }
    dark, bright = (f(stops, key=lambda name: stops[name]) for f in (min, max))
    return row(
        f"exposure between cameras, {bright} against {dark}",
        stops[bright] - stops[dark],
        "stops",
        warn_above=0.7,
        remedy="Mixed exposure: set the same exposure, gain and white balance by hand on all cameras.",
    )
