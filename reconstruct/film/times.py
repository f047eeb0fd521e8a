"""When a film's pictures are taken: times of the clip, in [0, 1] from its first to its last modelled time."""

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError

AT_REST_S = 4.0  # of a film of what does not move
BRIEF_S = 3.0  # motion that is over sooner is shown at half speed


def film_seconds(scene: Scene) -> float:
    """How long a film takes that shows the motion at its speed, or at half of it where that is brief."""
    if not scene.dynamic:
        return AT_REST_S
    span_s = scene.t1_s - scene.t0_s
    return span_s if span_s >= BRIEF_S else 2 * span_s


def film_times(scene: Scene, count: int) -> list[float | None]:
    """Times that run evenly from the first to the last; None throughout where nothing moves."""
    if not scene.dynamic:
        return [None] * count
    return [float(t) for t in np.linspace(0.0, 1.0, count)]


def parse_time(text: str, option: str, t0_s: float, t1_s: float) -> float:
    """A time in [0, 1] of `0.5`, or of seconds on the first camera's clock, `1.2s`.

    Raises:
        InputError: It is neither, or lies outside the clip.
    """
    in_seconds = text.strip().endswith("s")
    try:
        value = float(text.strip().removesuffix("s"))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        expected = "expected a share of the clip such as 0.5, or seconds such as 1.2s"
        raise InputError("option-malformed", f"{option} {text}: {expected}")
    time = (value - t0_s) / (t1_s - t0_s) if in_seconds and t1_s > t0_s else value
    if not -1e-6 <= time <= 1 + 1e-6:
        expected = f"expected 0 to 1, or {t0_s:.3f}s to {t1_s:.3f}s on the first camera's clock"
        raise InputError("option-out-of-range", f"{option} {text}: outside the clip; {expected}")
    return float(min(max(time, 0.0), 1.0))
