"""When a film's pictures are taken: times of the clip, in [0, 1] from its first to its last modelled time."""

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError


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
