"""How a stored picture is turned and mirrored into the one to be seen: by EXIF, or by a clip's display matrix.

A lens belongs to the stored picture: pictures of one camera that were made upright in two ways have two lenses, each of
them the other turned. `Upright.matrix` and `Upright.points` are the one rule for all that lies in a picture.
"""

from dataclasses import dataclass
from math import atan2, pi

import numpy as np
from jaxtyping import Float, Shaped

EXIF_QUARTERS = {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}
EXIF_MIRRORED = (2, 4, 5, 7)


@dataclass(frozen=True)
class Upright:
    """What makes a stored picture upright: first its columns are exchanged, left and right, then it is turned.

    Attributes:
        quarters: Quarter turns counter-clockwise, 0 to 3.
        mirrored: Whether columns are exchanged.
    """

    quarters: int = 0
    mirrored: bool = False

    @property
    def degrees(self) -> int:
        """The turn, degrees counter-clockwise."""
        return 90 * self.quarters

    @property
    def nothing(self) -> bool:
        """Whether pictures are upright as they are stored."""
        return not self.quarters and not self.mirrored

    @property
    def words(self) -> str:
        """What is done, for a note: "mirrored and turned by 180 degrees"; empty for nothing."""
        parts = ["mirrored"] * self.mirrored + [f"turned by {self.degrees} degrees"] * bool(self.quarters)
        return " and ".join(parts)

    @property
    def orientation(self) -> int:
        """EXIF's number for it, 1 to 8."""
        return next(n for n in range(1, 9) if by_exif(n) == self)

    @property
    def inverse(self) -> "Upright":
        """What makes the stored picture of the upright one."""
        return self if self.mirrored else Upright(-self.quarters % 4)

    def then(self, after: "Upright") -> "Upright":
        """This, and then `after`, as one."""
        own = -self.quarters if after.mirrored else self.quarters
        return Upright((own + after.quarters) % 4, self.mirrored != after.mirrored)

    @property
    def matrix(self) -> Float[np.ndarray, "2 2"]:
        """What it does to directions in the picture (right, down)."""
        turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), self.quarters)
        return (turn @ np.diag([-1, 1]) if self.mirrored else turn).astype(np.float64)

    def points(
        self, xy: Float[np.ndarray, "*batch 2"], width: int, height: int
    ) -> Float[np.ndarray, "*batch 2"]:
        """Where pixels [..., 2] of a stored picture of this size are in the upright one."""
        return (xy - np.array([width, height]) / 2) @ self.matrix.T + np.array(self.size(width, height)) / 2

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the upright picture; of the stored one, given those of the upright."""
        return (height, width) if self.quarters % 2 else (width, height)

    def apply(self, picture: Shaped[np.ndarray, "h w *channels"]) -> Shaped[np.ndarray, "h2 w2 *channels"]:
        """The upright picture; the one given where nothing is to be done."""
        if self.nothing:
            return picture
        import cv2  # where no picture is turned, as in a data set, OpenCV need not be there

        if self.mirrored:
            picture = cv2.flip(picture, 1)
        rotations = {1: cv2.ROTATE_90_COUNTERCLOCKWISE, 2: cv2.ROTATE_180, 3: cv2.ROTATE_90_CLOCKWISE}
        return picture if not self.quarters else cv2.rotate(picture, rotations[self.quarters])


def by_exif(orientation: int) -> Upright:
    """By an EXIF orientation (EXIF 2.3, tag 0x0112: which side of the scene row 0 and column 0 are)."""
    return Upright(EXIF_QUARTERS.get(orientation, 0), orientation in EXIF_MIRRORED)


def by_display_matrix(data: bytes) -> Upright:
    """By a display matrix: nine 32-bit numbers [a b u; c d v; x y w] that take (column, row) to (a p + c q, b p + d q).

    Its determinant tells whether it mirrors; the angle that is left is rounded to quarter turns.
    """
    a, b, _, c, d = np.frombuffer(data, dtype="=i4")[:5].astype(float).tolist()
    mirrored = a * d - b * c < 0
    angle = -atan2(-b, -a) if mirrored else -atan2(b, a)  # rows count downwards
    return Upright(round(angle / (pi / 2)) % 4, mirrored)
