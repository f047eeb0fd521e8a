"""What a camera that stands shows of the scene at rest: its picture at rest, or else its clean plate.

A clean plate is put together in time: at every pixel the median. Where other colours than that are seen for more than
half of the time, it is not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import gaussian_filter, maximum_filter

from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.pictures import spread
from devrf.reconstruct.plates import FEWEST_PICTURES, MOST_PICTURES, plate, stands

LASTING = 0.5  # of the pictures, in the middle of all, show what stands where a plate does
DIFFERENCE, BLUR_PX, REACH_PX = (
    0.05,
    1.2,
    2,
)  # design of `test_moving`: of the full range; standard deviation; dilation

Picture = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class StillPicture:
    """A camera's own picture of what stands.

    Attributes:
        picture: RGB in [0, 1], at the size of training.
        known: Where it shows what stands.
        source: `rest` or `plate`.
    """

    picture: Picture
    known: Mask
    source: str

    def moving(self, picture: Picture) -> Mask:
        """Where a picture of the same camera shows something else, and a little around."""
        blurred = gaussian_filter(picture - self.picture, (BLUR_PX, BLUR_PX, 0))
        return maximum_filter(np.abs(blurred).max(axis=-1) > DIFFERENCE, size=2 * REACH_PX + 1)


def still_picture(scene: Scene, frames: Sequence[PosedFrame]) -> StillPicture | None:
    """The picture of what stands of one camera; None where it moves, or has too few pictures for a plate.

    Args:
        scene: Whose `rest_time` says when its cameras show the rest.
        frames: All pictures of the camera, in the order of their times.
    """
    if not stands(frames):
        return None
    at_rest = _at_rest(scene, frames)
    if at_rest is not None:
        picture = _load(scene, at_rest)
        return StillPicture(picture.astype(np.float32) / 255, np.ones(picture.shape[:2], dtype=bool), "rest")
    if len(frames) < FEWEST_PICTURES:
        return None
    picture, known = plate(
        np.stack([_load(scene, frame) for frame in spread(frames, MOST_PICTURES)]), LASTING
    )
    return StillPicture(picture.astype(np.float32) / 255, known, "plate")


def _at_rest(scene: Scene, frames: Sequence[PosedFrame]) -> PosedFrame | None:
    """The picture taken at the time of rest, within a picture's distance from the next."""
    times = np.array([frame.time for frame in frames], dtype=float)
    if scene.rest_time is None or len(times) < 2:
        return None
    nearest = int(np.abs(times - scene.rest_time).argmin())
    apart = float(np.diff(times).max())
    return frames[nearest] if abs(times[nearest] - scene.rest_time) <= apart else None


def _load(scene: Scene, frame: PosedFrame) -> np.ndarray:
    return load_image(frame, scene.image_scale, scene.background)
