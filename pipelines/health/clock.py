"""Whether a clock is known at all: asked by stage `sync`, and once more by `scene`, where geometry may have helped."""

from devrf.calibration.clocks.equations import Clock
from devrf.capture.frames import CameraFrames
from devrf.pipelines.health.rows import HealthRow, row

REFUSED_BELOW = 0.5  # confidence of a cue that is only just accepted
# standard deviation of a clock that is worth a warning: frames cannot be told apart surely
UNSURE_FRAMES = 0.25
USUAL_FPS = 30.0  # of a camera whose rate is not known
BY_GEOMETRY = "Stage scene tries by geometry, since something moves in view. If that fails: "
BY_TRACKING = (
    "It is good to about three pictures, and stage deformation moves it where what moves says more. If not: "
)
REMEDY = (
    "Film with sound and clap a few times at uneven intervals; or flash a light a few times, bright enough for all "
    "cameras; or let somebody jump; or give capture.timestamps; or, for cameras synchronised by hardware, set "
    "calibration.sync.method to none."
)


def confidence_row(name: str, clock: Clock, why: str, hope: str = "") -> HealthRow:
    """Judge the worst clock.

    Args:
        name: Its camera.
        clock: The clock.
        why: What is known of the reason, in words; empty: the clock's own basis.
        hope: What can still make it better, a sentence; with none a clock that is not known is refused.
    """
    return row(
        f"confidence, worst camera ({name})",
        clock.confidence,
        warn=0.6,
        fail=None if hope else REFUSED_BELOW,
        remedy=f"The clock of {name} is not known: {why or clock.basis}. {hope}{REMEDY}",
    )


def frame_ms(camera: CameraFrames) -> float:
    """Milliseconds from one picture to the next."""
    return 1e3 / (camera.fps_mean or USUAL_FPS)
