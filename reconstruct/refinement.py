"""Sizes of the pictures of one view: a small one that comes at once, then larger ones while nobody asks for another.

Sizes are counted in halvings of the number of pixels: 0 is the whole picture, 2 has half as many pixels per side.
"""

from dataclasses import dataclass

MOVING_S = 0.12  # what a picture of a view that changes may take: eight a second look like motion
REFINED = 2  # halvings between two pictures of a view that rests
FIRST = 12_000.0  # pixels, until a picture has been timed: a core has them in time
FEWEST = 1_000  # pixels: less shows nothing
SURPRISE = 4.0  # a picture changes the budget by no more: one may have had to wait for something else


@dataclass
class Pace:
    """How large a picture may be that has to be there soon, learned from those before.

    Attributes:
        budget: Pixels.
    """

    budget: float = FIRST

    def note(self, pixels: int, seconds: float) -> None:
        """What a picture took; most of a small one's time has nothing to do with its size."""
        factor = min(max(MOVING_S / max(seconds, 1e-6), 1 / SURPRISE), SURPRISE)
        self.budget = (self.budget + pixels * factor) / 2

    def first(self, pixels: int) -> int:
        """Halvings with which a picture of so many pixels is there in time."""
        halvings = 0
        while pixels / 2**halvings > max(FEWEST, self.budget * 2**0.5):  # to the nearest
            halvings += 1
        return halvings


def next_size(halvings: int) -> int:
    """Halvings of the picture that follows."""
    return max(0, halvings - REFINED)


def at_size(width: int, height: int, halvings: int) -> tuple[int, int]:
    """Width and height after so many halvings of the number of pixels."""
    scale = 2.0 ** (-halvings / 2)
    return max(2, round(width * scale)), max(2, round(height * scale))


def at_most(width: int, height: int, pixels: int) -> tuple[int, int]:
    """Width and height of the largest picture of this shape with at most so many pixels."""
    scale = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(2, int(width * scale)), max(2, int(height * scale))
