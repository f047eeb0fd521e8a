"""The pictures that one fixed camera took of the moving scene, at the size at which motion is tracked."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.flow.estimator import FlowEstimator
from devrf.reconstruct.pictures import clips, stands
from devrf.reconstruct.still_picture import FEWEST_PICTURES

SIDE = 512  # pixels: the longest side of pictures that are tracked; finer ones gain less than they cost
REMEMBERED = 12  # pictures of a film, and as many filtered ones
# Of the high-pass: standard deviations at a longest side of 640 pixels, and what keeps the logarithm finite.
FINE_PX, COARSE_PX, DARK, REFERENCE_SIDE = 0.7, 6.0, 0.05, 640
ROW = 1024  # points that are looked up in a row
GREY_GAIN = 300  # levels of 8 bits for a contrast of 1 in the logarithm

Picture = Float32[np.ndarray, "h w 3"]


@dataclass
class Film:
    """One camera's pictures in the order of their times, read when they are asked for.

    Attributes:
        name: Of the camera.
        camera: At the size of tracking, in the box frame.
        frames: Its pictures.
        times: Of the pictures, in the scene's time of [0, 1]; negative, in falling order, where time runs back.
        scale, background: As `load_image` takes them.
        estimator: Finds optical flow.
        depth: Along the optical axis, of what stands [h, w]; infinite where nothing is.
        plate: What stands, as the camera shows it [h, w, 3]; the model's picture where it never does.
    """

    name: str
    camera: Camera
    frames: Sequence[PosedFrame]
    times: np.ndarray
    scale: float
    background: str
    estimator: FlowEstimator
    depth: np.ndarray
    plate: np.ndarray
    _pictures: OrderedDict[int, np.ndarray] = field(default_factory=OrderedDict, repr=False)
    _sharp: OrderedDict[int, np.ndarray] = field(default_factory=OrderedDict, repr=False)

    def picture(self, n: int) -> Picture:
        """RGB in [0, 1]."""
        if n not in self._pictures:
            self._pictures[n] = load_image(self.frames[n], self.scale, self.background)
            while len(self._pictures) > REMEMBERED:
                self._pictures.popitem(last=False)
        return self._pictures[n].astype(np.float32) / 255

    def sharp(self, n: int) -> Picture:
        """`high_pass` of a picture."""
        if n not in self._sharp:
            self._sharp[n] = self.high_pass(self.picture(n))
            while len(self._sharp) > REMEMBERED:
                self._sharp.popitem(last=False)
        return self._sharp[n]

    def high_pass(self, picture: Picture) -> Picture:
        """Contrast in the logarithm of brightness: without shading, which is no motion, and without noise."""
        scale = max(picture.shape[:2]) / REFERENCE_SIDE
        logarithm = np.log(picture + DARK)
        return blurred(logarithm, FINE_PX * scale) - blurred(logarithm, COARSE_PX * scale)

    def flow(self, one: Picture, other: Picture) -> tuple[np.ndarray, np.ndarray]:
        """Flow between two high-pass pictures, and by how many pixels the flow back misses."""
        grey = [_grey(picture) for picture in (one, other)]
        flow, back = self.estimator.estimate(*grey), self.estimator.estimate(*grey[::-1])
        return flow, round_trip(flow, back)

    def nearest(self, time: float, within: float) -> int | None:
        """The picture taken next to a time, if that is near enough."""
        n = int(np.argmin(np.abs(self.times - time)))
        return n if abs(self.times[n] - time) <= within else None

    def backwards(self) -> "Film":
        """The same, run from its end to its beginning."""
        return Film(
            self.name, self.camera, self.frames[::-1], -self.times[::-1], self.scale, self.background,
            self.estimator, self.depth, self.plate,
        )  # fmt: skip


def standing_clips(scene: Scene) -> dict[str, list[PosedFrame]]:
    """Pictures of the training cameras that stand and have enough of them."""
    return {
        name: frames
        for name, frames in clips(scene).items()
        if len(frames) >= FEWEST_PICTURES and stands(frames)
    }


def films(scene: Scene, estimator: FlowEstimator) -> list[Film]:
    """Of each fixed training camera; what stands is not known yet: no depth, and black plates."""
    out = []
    for name, frames in standing_clips(scene).items():
        whole = frames[0].camera
        scale = min(1.0, SIDE / max(whole.width, whole.height))
        camera = whole.scaled(scale)
        size = (camera.height, camera.width)
        times = np.array([f.time for f in frames], dtype=float)
        depth, plate = np.full(size, np.inf), np.zeros((*size, 3), np.float32)
        out.append(Film(name, camera, frames, times, scale, scene.background, estimator, depth, plate))
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


def round_trip(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """By how many pixels one misses where one started, there and back [h, w]."""
    import cv2

    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in flow.shape[1::-1]))
    there = cv2.remap(
        back, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.linalg.norm(flow + there, axis=-1)


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    """By a Gaussian of a standard deviation in pixels; 0: as it is."""
    import cv2

    return cv2.GaussianBlur(picture, (0, 0), sigma) if sigma > 0 else picture


def _grey(high: Picture) -> UInt8[np.ndarray, "h w 3"]:
    level = (high.mean(-1) * GREY_GAIN + 128).clip(0, 255).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=-1)
