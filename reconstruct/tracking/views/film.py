"""The pictures that one fixed camera took of the moving scene, at the size at which motion is tracked."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import to_8_bits
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.flow.consistency import both_ways
from devrf.flow.estimator import FlowEstimator, takes_contrast
from devrf.reconstruct.sampling.clean_plate import standing_clips

SIDE = 512  # pixels: the longest side of pictures that are tracked; finer ones gain less than they cost
# Of a film that are remembered: those that points were first seen in are asked again and again.
PICTURES, SHARP = 64, 3
# Of the high-pass: standard deviations at a longest side of 640 pixels, and what keeps the logarithm finite.
FINE_PX, COARSE_PX, DARK, REFERENCE_SIDE = 0.7, 6.0, 0.05, 640
WIDE_PX = 24.0  # instead of COARSE_PX: flow finds no way that is much longer than what pictures keep is wide
ROW = 1024  # points that are looked up in a row
GREY_GAIN = 300  # levels of 8 bits for a contrast of 1 in the logarithm

Picture = Float32[np.ndarray, "h w 3"]


@dataclass
class CameraFilm:
    """One camera's pictures in the order of their times, read when they are asked for.

    Attributes:
        camera: At the size of tracking, in the box frame.
        frames: Its pictures.
        times: Of the pictures, in the scene's time of [0, 1]; negative, in falling order, where time runs back.
        scale, background: As `load_image` takes them.
        estimator: Finds optical flow.
        depth: Along the optical axis, of what stands [h, w]; infinite where nothing is.
        plate: What stands, as the camera shows it [h, w, 3]; the model's picture where it never does.
        sure: Whether its clock is known: it is not moved.
    """

    camera: Camera
    frames: Sequence[PosedFrame]
    times: np.ndarray
    scale: float
    background: str
    estimator: FlowEstimator
    depth: np.ndarray
    plate: np.ndarray
    sure: bool = False
    _pictures: OrderedDict[int, np.ndarray] = field(default_factory=OrderedDict, repr=False)
    _sharp: OrderedDict[int, np.ndarray] = field(default_factory=OrderedDict, repr=False)

    def picture(self, n: int) -> Picture:
        """RGB in [0, 1]."""
        read = _remembered(
            self._pictures, n, PICTURES, lambda: load_image(self.frames[n], self.scale, self.background)
        )
        return read.astype(np.float32) / 255

    def sharp(self, n: int) -> Picture:
        """`high_pass` of a picture."""
        return _remembered(self._sharp, n, SHARP, lambda: self.high_pass(self.picture(n)))

    def wide(self, n: int) -> Picture:
        """The same with what is wider, by which things are found that went far; shading is in it, too."""
        return self.high_pass(self.picture(n), WIDE_PX)

    def high_pass(self, picture: Picture, coarse_px: float = COARSE_PX) -> Picture:
        """Contrast in the logarithm of brightness: without shading, which is no motion, and without noise.

        Of a whole picture of the film or of a piece of one.
        """
        scale = max(self.camera.width, self.camera.height) / REFERENCE_SIDE
        logarithm = np.log(picture + DARK)
        return blurred(logarithm, FINE_PX * scale) - blurred(logarithm, coarse_px * scale)

    def for_flow(self, picture: Picture, high: Picture) -> UInt8[np.ndarray, "h w 3"]:
        """What the estimator of flow is shown of a picture: itself, or its `high`-pass in grey."""
        return _grey(high) if takes_contrast(self.estimator) else to_8_bits(picture)

    def flow(
        self, one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow between two pictures made `for_flow`, and by how many pixels the flow back misses."""
        flow, missed, _ = both_ways(self.estimator, one, other)
        return flow, missed

    def nearest(self, time: float, within: float) -> int | None:
        """The picture taken next to a time, if that is near enough."""
        n = int(np.argmin(np.abs(self.times - time)))
        return n if abs(self.times[n] - time) <= within else None

    def backwards(self) -> "CameraFilm":
        """The same, run from its end to its beginning."""
        return CameraFilm(
            self.camera, self.frames[::-1], -self.times[::-1], self.scale, self.background,
            self.estimator, self.depth, self.plate, self.sure,
        )  # fmt: skip


def films(scene: Scene, estimator: FlowEstimator) -> list[CameraFilm]:
    """Of each fixed training camera; what stands is not known yet: no depth, and black plates."""
    out = []
    for name, frames in standing_clips(scene).items():
        whole = frames[0].camera
        scale = min(1.0, SIDE / max(whole.width, whole.height))
        camera = whole.scaled(scale)
        size = (camera.height, camera.width)
        times = np.array([f.time for f in frames], dtype=float)
        depth, plate = np.full(size, np.inf), np.zeros((*size, 3), np.float32)
        sure = name in scene.sure_clocks
        out.append(CameraFilm(camera, frames, times, scale, scene.background, estimator, depth, plate, sure))
    return out


def sampled(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values of a picture [h, w, ...] at pixels [n, 2] whose centres are at halves, linearly; the border goes on."""
    return fetched(values, at - 0.5)


def fetched(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The same at pixels whose centres are at whole numbers."""
    import cv2  # only what tracks needs it

    rows = -(-len(at) // ROW)  # OpenCV has a limit for the length of rows
    if not rows:
        return np.zeros((0, *values.shape[2:]), np.float32)
    padded = np.zeros((rows * ROW, 2), np.float32)
    padded[: len(at)] = at
    x, y = padded.reshape(rows, ROW, 2).transpose(2, 0, 1).copy()
    out = cv2.remap(values.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(rows * ROW, *values.shape[2:])[: len(at)]


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """By a Gaussian of a standard deviation in pixels; 0: as it is."""
    import cv2

    return cv2.GaussianBlur(picture, (0, 0), sigma) if sigma > 0 else picture


def _remembered(
    kept: OrderedDict[int, np.ndarray], n: int, most: int, make: Callable[[], np.ndarray]
) -> np.ndarray:
    """What is kept of number `n`, or made now; those that were asked for longest ago go."""
    if n not in kept:
        kept[n] = make()
        if len(kept) > most:
            kept.popitem(last=False)
    kept.move_to_end(n)
    return kept[n]


def _grey(high: Picture) -> UInt8[np.ndarray, "h w 3"]:
    level = ((high[..., 0] + high[..., 1] + high[..., 2]) / 3 * GREY_GAIN + 128).clip(0, 255).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=-1)
