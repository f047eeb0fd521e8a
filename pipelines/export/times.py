"""Which times of a moving scene are exported: `--times`."""

from dataclasses import dataclass

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.reconstruct.film.times import parse_time

MOST = 10_000  # files in one folder
KEYS = "keys"


@dataclass(frozen=True)
class ExportTime:
    """A time that is exported.

    Attributes:
        time: In [0, 1]; None: the scene at rest.
        time_s: Seconds on the first camera's clock; None: the scene at rest.
    """

    time: float | None
    time_s: float | None

    def said(self) -> str:
        """In words."""
        return "at rest" if self.time_s is None else f"at {self.time_s:.4f} s"


REST = ExportTime(None, None)


def chosen(text: str, scene: Scene, keys: list[float]) -> list[ExportTime]:
    """The times that an option names, in order.

    Args:
        text: A number of times, spread evenly; `keys`; or times as `render --time` takes them, with commas.
        scene: Whose time runs from `t0_s` to `t1_s`.
        keys: The model's key times, or the moments of its movers, in [0, 1].
    Raises:
        InputError: Not understood, or outside the clip.
    """
    if text.strip() == KEYS:
        times = keys
    elif text.strip().isdecimal():
        if not 1 <= int(text) <= MOST:
            text = f"--times {text}: expected a number of times from 1 to {MOST}"
            raise InputError("option-out-of-range", text)
        times = np.linspace(0.0, 1.0, int(text)).tolist()
    else:
        parts = [part.strip() for part in text.split(",")]
        if KEYS in parts or not all(parts):
            wrong = f"--times {text!r}: expected a number of times, {KEYS}, or times with commas such as 0.5s,1.25s"
            raise InputError("option-malformed", wrong)
        times = sorted({parse_time(part, "--times", scene.t0_s, scene.t1_s) for part in parts})
    return [ExportTime(time, scene.t0_s + time * (scene.t1_s - scene.t0_s)) for time in times]
