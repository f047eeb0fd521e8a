"""Whether a clock is known at all: asked by stage `sync`, and once more by `scene`, where geometry may have helped."""

from devrf.calibration.clocks.equations import Clock
from devrf.capture.frames import CameraFrames
from devrf.capture.measure import Measure

REFUSED_BELOW = 0.5  # confidence of a cue that is only just accepted
# standard deviation of a clock that is worth a warning: frames cannot be told apart surely
UNSURE_FRAMES = 0.25
USUAL_FPS = 30.0  # of a camera whose rate is not known
BY_GEOMETRY = "Stage scene tries by geometry, since something moves in view. If that fails: "
BY_TRACKING = (
    "It is good to about three pictures, and stage deformation moves it where what moves says more. If not: "
)


def confidence_measure(name: str, clock: Clock, why: str, hope: str = "", refuses: bool = True) -> Measure:
    """How sure the worst clock is.

    Args:
        name: Its camera.
        clock: The clock.
        why: What is known of the reason, in words; empty: the clock's own basis.
        hope: What can still make it better, a sentence; with none a clock that is not known is refused.
        refuses: Whether it is refused; not where enough other cameras have clocks.
    """
    leave = f"; or go on without {name}: take it out of capture.cameras"
    facts = {"reason": why or clock.basis, "hope": hope, "leave": leave}
    fail = None if hope else REFUSED_BELOW
    return Measure("clock-unknown", clock.confidence, name, facts=facts, fail=fail, refuses=refuses)


def frame_ms(camera: CameraFrames) -> float:
    """Milliseconds from one picture to the next."""
    return 1e3 / (camera.fps_mean or USUAL_FPS)
