"""The clocks in `check`: by sound; where it does not reach every camera, by motion and flashes in the first seconds."""

from devrf.calibration.clocks.cues import Extras
from devrf.calibration.clocks.flash import Brightness
from devrf.calibration.clocks.sync import SyncResult, synchronise
from devrf.capture.frames import CameraFrames
from devrf.capture.ingest.signals import read_courses
from devrf.capture.measure import Measure
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import CalibrationError
from devrf.capture.video.audio import Sound
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.clock_rows import REFUSED_BELOW
from devrf.pipelines.stages import sync

COURSE_S = 20.0  # of each clip; more would cost minutes at 4K


def clock_measures(
    config: SceneConfig, session: CaptureSession, moving: dict[str, CameraFrames], sounds: dict[str, Sound]
) -> list[Measure]:
    """What stage `sync` measures."""
    if len(moving) < 2:
        return []
    settings, table = config.calibration.sync, session.timestamps is not None
    times = {name: sync.used_times(frames) for name, frames in moving.items()}
    spans = {name: (float(t[0]), float(t[-1])) for name, t in times.items()}

    def solve(seconds: float) -> SyncResult:
        clips = session.cameras.items() if seconds else ()
        courses = {name: read_courses(path, seconds) for name, path in clips}
        brightness = {n: Brightness(c.brightness[:, 0], c.brightness[:, 1:]) for n, c in courses.items()}
        motion = {n: c.motion for n, c in courses.items()}
        # Of a long clip the end is not read.
        rest = "start" if config.rest == "start" else "none"
        extras = Extras(brightness, sync.recorded(moving), settings.av_lag_s, settings.readout_s, rest, table)
        return synchronise(spans, sounds, motion, settings.method, extras=extras)

    try:
        by_sound = len(sounds) > 1 or settings.method in ("timestamps", "none")
        result = solve(0.0 if by_sound else COURSE_S)
        unknown = any(clock.confidence < REFUSED_BELOW for clock in result.cameras.values())
        if unknown and len(sounds) > 1 and settings.method in ("auto", "motion", "flash"):
            result = solve(COURSE_S)
    except CalibrationError as error:
        facts = {"reason": "no cue tells it", "hope": "", "leave": ""}
        return [Measure("clock-unknown", str(error), "all cameras", facts=facts, found="fail")]
    return sync.measures(moving, result)
