"""How a film's time runs: as it was, slowly, slowly between two times, there and back, or not at all.

Times of the clip are in [0, 1] from its first to its last modelled time, which are `clip_s` seconds apart.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.capture.errors import InputError
from devrf.capture.scene import Scene

STANDING_S = 4.0  # length of a film in which time stands still, where none is named


@dataclass(frozen=True)
class TimeCurve:
    """How time runs.

    Attributes:
        clip_s: Seconds from time 0 to time 1.
        begin, end: The part of the clip that is shown.
        speed: Seconds of the clip in a second of the film; None: as the film's length asks for, else 1.
        slow: Only between these two times it runs at `speed`, elsewhere as it was; None: everywhere.
        ping_pong: Back again from the end.
    """

    clip_s: float
    begin: float = 0.0
    end: float = 1.0
    speed: float | None = None
    slow: tuple[float, float] | None = None
    ping_pong: bool = False

    def natural_s(self) -> float:
        """Length of the film that shows all of it once."""
        length = float(self._marks()[0][-1])
        return 2 * length if self.ping_pong else length

    def times(self, count: int, fps: float) -> Float[np.ndarray, " count"]:
        """Time of each picture, the first one at `begin`.

        Raises:
            InputError: The film is longer than what it shows, at this speed.
        """
        marks, times = self._marks()
        length = float(marks[-1])
        if self.speed is None and not self.ping_pong:
            return np.linspace(self.begin, self.end, count)
        if self.speed is None:
            at = 2 * length * np.arange(count) / count
        else:
            at = np.arange(count) / fps
            if not self.ping_pong and at[-1] > length + 1e-6:
                text = f"--seconds {count / fps:g}: at --speed {self.speed:g} the clip lasts {length:.3g} s"
                remedy = "leave out one of the two, or let time run back with --ping-pong"
                raise InputError("film-too-long", f"{text}; {remedy}")
        there = at % (2 * length) if self.ping_pong else at
        return np.interp(np.minimum(there, 2 * length - there), marks, times)

    def _marks(self) -> tuple[np.ndarray, np.ndarray]:
        """Seconds of the film, and times of the clip: between them it runs evenly."""
        speed = 1.0 if self.speed is None else self.speed
        if self.slow is None:
            return np.array([0.0, (self.end - self.begin) * self.clip_s / speed]), np.array(
                [self.begin, self.end]
            )
        first, last = (min(max(time, self.begin), self.end) for time in self.slow)
        times = np.array([self.begin, first, last, self.end])
        seconds = np.diff(times) * self.clip_s / np.array([1.0, speed, 1.0])
        return np.append(0, np.cumsum(seconds)), times


def film_times(scene: Scene, count: int) -> list[float | None]:
    """Times that run evenly from the first to the last; None throughout where nothing moves."""
    if not scene.dynamic:
        return [None] * count
    return [float(t) for t in np.linspace(0.0, 1.0, count)]


def picture_count(seconds: float, fps: float, both_ends: bool) -> int:
    """Pictures of a film; `both_ends`: the last one stands at its end, where nothing follows."""
    return max(1, int(seconds * fps + 1e-6) + 1 if both_ends else round(seconds * fps))


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
