"""Cameras that a run goes on without."""

from devrf.capture.measure import Measure

NO_PICTURE = "it takes no picture while two training cameras film"  # why a test camera is left out of a scene


def left_out(name: str, reason: str) -> Measure:
    """A test camera that cannot be measured with; everything else is as without it."""
    return Measure("camera-left-out", "test camera", name, "test", {"reason": reason})
