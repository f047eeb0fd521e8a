"""What a camera that stands shows of the scene at rest: its picture at rest, or else its clean plate.

A clean plate is put together in time: at every pixel the median. Where other colours than that are seen for more than
half of the time, it is not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.ndimage import binary_opening, gaussian_filter, maximum_filter

from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.capture.system.spread import spread
from devrf.reconstruct.sampling.pictures import clips, stands

MOST_PICTURES, FEWEST_PICTURES = 61, 5  # of a plate
MOST_BYTES = 1 << 28  # of a plate's pictures: 43 of 1920 x 1080
# Spread of a pixel that is motion: so many times that of half of the pixels, and so many levels more.
SPREAD, SPREAD_LEVELS = 2.2, 6
# levels; half of the pixels spread by more only where they move, too: in six captures by 3 to 15
NOISIEST = 24
PLATE_REACH_PX = 9  # side of the square by which what moves is grown
LASTING = 0.5  # of the pictures, in the middle of all, show what stands where a plate does
# Of `test_moving`: difference, of the full range; standard deviation of the blur; dilation.
DIFFERENCE, BLUR_PX, REACH_PX = 0.05, 1.2, 2

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


def standing_clips(scene: Scene) -> dict[str, list[PosedFrame]]:
    """Pictures of the training cameras that stand and have enough of them for a plate, by camera."""
    return {
        name: frames
        for name, frames in clips(scene).items()
        if len(frames) >= FEWEST_PICTURES and stands(frames)
    }


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
    picture, known = plate(scene, frames, LASTING)
    return StillPicture(picture.astype(np.float32) / 255, known, "plate")


def plate(
    scene: Scene, frames: Sequence[PosedFrame], share: float = 0.9
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The median of a camera's pictures, and where this share of them differ by no more than noise.

    Args:
        scene: Says how large pictures are trained on.
        frames: Of one camera that stands.
        share: Of the pictures, around the median.
    """
    camera = frames[0].camera.scaled(scene.image_scale)
    most = min(MOST_PICTURES, max(FEWEST_PICTURES, MOST_BYTES // (3 * camera.width * camera.height)))
    chosen = spread(frames, most)
    pictures = np.empty((len(chosen), camera.height, camera.width, 3), np.uint8)
    for n, frame in enumerate(chosen):
        pictures[n] = _load(scene, frame)
    order = [round(q * (len(pictures) - 1)) for q in (0.5 - share / 2, 0.5, 0.5 + share / 2)]
    pictures.partition(order, axis=0)  # in place: a copy would be as large again
    low, middle, high = pictures[order]
    apart = (high.astype(np.int16) - low).max(axis=-1)
    usual = min(float(np.median(apart)), NOISIEST)
    moves = binary_opening(apart > max(SPREAD * usual, usual + SPREAD_LEVELS), np.ones((3, 3)))
    return middle, np.logical_not(maximum_filter(moves, size=PLATE_REACH_PX))


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
