"""How long-running functions tell how far they are, without knowing who listens."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""`progress(fraction, message)`: the done share in [0, 1] and a short text such as "12 of 60 frames"."""


def no_progress(fraction: float, message: str) -> None:
    """Ignore progress."""


def part(progress: Progress, start: float, share: float) -> Progress:
    """Progress of a part of a larger piece of work, which begins at `start` and makes up `share` of it."""
    return lambda fraction, message: progress(start + share * fraction, message)
