"""What a matte says about itself: how much it shows, and where."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

ANY = 25  # of 255, of a small pixel: a tenth of it shows the subject
LEAST_SUBJECT = 5e-4  # of the picture: less shows no subject


@dataclass(frozen=True)
class MatteFacts:
    """Of one matte.

    Attributes:
        area: Share of the picture that is subject.
        small: The matte at a small size: where any of it is shown.
    """

    area: float
    small: Bool[np.ndarray, "h w"]


def measure(matte: UInt8[np.ndarray, "h w"], small_size: tuple[int, int]) -> MatteFacts:
    """Look at one matte; `small_size` is the (width, height) of `small`."""
    small = cv2.resize(matte, small_size, interpolation=cv2.INTER_AREA) > ANY
    return MatteFacts(float((matte > 127).mean()), small)
