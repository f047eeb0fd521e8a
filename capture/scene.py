"""A calibrated scene: pictures with cameras and times, and the box that the model fills.

The *sweep* (`static`) shows the scene at rest, the *moving cameras* (`dynamic`) show it in motion. The
similarity `box_from_world` takes world points into the box frame, in which the box is centred at the
origin and its longest half side is 1. `time` is 0 at `t0_s` and 1 at `t1_s` on cam0's clock.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.capture.camera import RIGID_TOLERANCE, Camera
from devrf.capture.colour.correction import Look
from devrf.capture.photos.picture_files import read_pixels, read_reduced
from devrf.capture.photos.resize import shrink
from devrf.capture.system.errors import CaptureError

Background = str  # "shell", "white", "black" or "#rrggbb" (`plain_colour`)
PLAIN_COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
Kind = Literal["inward", "forward"]
Split = Literal["train", "test"]


@dataclass(frozen=True)
class PosedFrame:
    """One picture with its camera and time.

    Attributes:
        path: The picture, full size; may carry alpha.
        camera: Calibration at full size; metric or arbitrary scale, as the scene says.
        camera_name: `static` for the sweep, else the name of the clip.
        index: Number of the frame in its clip.
        time_s: On cam0's clock; None for the sweep.
        time: `time_s` mapped to [0, 1]; None for the sweep.
        split: Pictures of split `test` are never trained on.
        flow: Backward flow that a data set brings with the picture (`capture.formats.flow_files`), or None.
        look: What brings its colours to the reference camera's when it is loaded; None: nothing.
        matte: Where the subject is: a grey picture of the same size, white is the subject; or None. Before a plain
            background it is the picture's alpha; where surroundings are seen it changes no picture.
    """

    path: Path
    camera: Camera
    camera_name: str
    index: int
    time_s: float | None
    time: float | None
    split: Split
    flow: Path | None = None
    look: Look | None = None
    matte: Path | None = None


@dataclass(frozen=True)
class SparsePoints:
    """Points of the scene at rest, as structure from motion found them, and which pictures show them.

    Attributes:
        xyz: Positions in the world.
        obs_point: Of every observation: the point, a row of `xyz`.
        obs_frame: Of every observation: the picture, a place in `Scene.static`.
    """

    xyz: Float[np.ndarray, "points 3"]
    obs_point: Int[np.ndarray, " observations"]
    obs_frame: Int[np.ndarray, " observations"]

    def lines_of_sight(
        self, static: tuple[PosedFrame, ...]
    ) -> tuple[Float[np.ndarray, "observations 3"], Float[np.ndarray, "observations 3"]]:
        """Of every observation: the camera's centre and the point, for the pictures of `Scene.static`."""
        centres = np.array([frame.camera.centre for frame in static])
        return centres[self.obs_frame], self.xyz[self.obs_point]


@dataclass(frozen=True)
class Scene:
    """Everything the reconstruction needs to know.

    Attributes:
        static: Pictures of the scene at rest.
        dynamic: Pictures of the scene in motion; may be empty.
        box_from_world: Similarity [4, 4].
        aabb: Box corners [2, 3] (lowest, highest) in the box frame.
        near, far: Nearest and farthest content along rays, in box frame units.
        kind: `inward` (cameras around the subject) or `forward`.
        background: `shell` where the surroundings are seen, else the plain colour behind the subject:
            `white`, `black` or `#rrggbb`.
        t0_s, t1_s: First and last modelled time, seconds on cam0's clock.
        rest_time: `time` at which the moving clips show the scene as in the sweep; None if never.
        image_scale: Pictures are trained on and evaluated at this relative size.
        metric: Whether world units are metres.
        points: What structure from motion found beside the poses; None for data sets without.
        ndc: Where the scene is modelled in normalised device coordinates: tangents of the reference camera's half
            angles (width / 2 / fx, height / 2 / fy). That camera is at the origin of the box frame and looks along
            +z; the near plane is at z = 1. None elsewhere.
        sure_clocks: Cameras whose times sound and pictures agree on: tracking does not move them. Not on disk.
    """

    static: tuple[PosedFrame, ...]
    dynamic: tuple[PosedFrame, ...]
    box_from_world: Float[np.ndarray, "4 4"]
    aabb: Float[np.ndarray, "2 3"]
    near: float
    far: float
    kind: Kind
    background: Background
    t0_s: float
    t1_s: float
    rest_time: float | None
    image_scale: float
    metric: bool = False
    points: SparsePoints | None = None
    ndc: tuple[float, float] | None = None
    sure_clocks: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not self.static and not self.dynamic:
            raise CaptureError("pictures-none", "the scene has no pictures")
        if self.box_from_world.shape != (4, 4) or not _is_similarity(self.box_from_world):
            raise ValueError(f"box_from_world is no similarity: {self.box_from_world.tolist()}")
        if not (self.aabb[1] > self.aabb[0]).all():
            raise ValueError(f"scene box is empty: {self.aabb.tolist()}")
        if not 0 <= self.near < self.far:
            raise ValueError(f"near {self.near} and far {self.far} must satisfy 0 <= near < far")
        if not 0 < self.image_scale <= 1:
            raise ValueError(f"image_scale is {self.image_scale}, expected more than 0 and at most 1")
        if self.ndc is not None and not min(self.ndc) > 0:
            raise ValueError(f"ndc is {self.ndc}, expected two tangents above 0")
        plain_colour(self.background)

    @property
    def frames(self) -> tuple[PosedFrame, ...]:
        """All pictures, the sweep first."""
        return self.static + self.dynamic

    def in_box_frame(self) -> "Scene":
        """The same scene with its cameras moved into the box frame."""

        def moved(frames: Iterable[PosedFrame]) -> tuple[PosedFrame, ...]:
            return tuple(replace(f, camera=f.camera.moved(self.box_from_world)) for f in frames)

        points = self.points
        if points is not None:
            R, t = self.box_from_world[:3, :3], self.box_from_world[:3, 3]
            points = replace(points, xyz=points.xyz @ R.T + t)
        return replace(
            self,
            static=moved(self.static),
            dynamic=moved(self.dynamic),
            points=points,
            box_from_world=np.eye(4),
            metric=False,
        )


def by_camera(frames: Iterable[PosedFrame]) -> dict[str, list[PosedFrame]]:
    """The frames of each camera, all in their order."""
    found: dict[str, list[PosedFrame]] = {}
    for frame in frames:
        found.setdefault(frame.camera_name, []).append(frame)
    return found


def plain_colour(background: Background) -> tuple[float, float, float] | None:
    """RGB in [0, 1] of a plain background; None for `shell`, where the surroundings are seen.

    Raises:
        ValueError: Neither `shell`, `white`, `black` nor `#rrggbb`.
    """
    if background == "shell":
        return None
    if background in PLAIN_COLOURS:
        return PLAIN_COLOURS[background]
    if not re.fullmatch("#[0-9a-fA-F]{6}", background):
        raise ValueError(f"background is {background!r}, expected shell, white, black or #rrggbb")
    red, green, blue = (int(background[n : n + 2], 16) / 255 for n in (1, 3, 5))
    return red, green, blue


def background_of(rgb: tuple[float, float, float]) -> Background:
    """The name of a plain colour, RGB in [0, 1]: `white`, `black` or `#rrggbb` (rounded to 8 bits)."""
    code = "#" + "".join(f"{round(255 * value):02x}" for value in rgb)
    return {"#ffffff": "white", "#000000": "black"}.get(code, code)


def load_image(frame: PosedFrame, scale: float, background: Background) -> UInt8[np.ndarray, "h w 3"]:
    """The frame's picture, resized by area and, where it carries alpha, composited on the plain background.

    Colours are weighted by alpha while resizing, so that hidden colours do not bleed into edges.
    """
    camera, small = frame.camera, frame.camera.scaled(scale)
    size = small.width, small.height
    if frame.matte is not None and background != "shell":
        image, divisor = read_matted(frame, background), 1
    else:
        image, divisor = read_reduced(frame.path, *size)
        image = _looked(frame, image)
    height, width = (divisor * side for side in image.shape[:2])
    if (width, height) != (camera.width, camera.height):
        calibrated = f"{camera.width}x{camera.height}"
        wrong = f"{frame.path}: picture is {width}x{height}, its calibration is for {calibrated}"
        raise CaptureError("picture-size-wrong", f"{wrong}; calibrate at the size of the pictures")
    if image.shape[2] == 4:
        alpha = image[..., 3:].astype(np.float32) / 255
        behind = np.float32(255) * np.array(plain_colour(background) or PLAIN_COLOURS["white"], np.float32)
        premultiplied = image[..., :3] * alpha + behind * (1 - alpha)
        return np.clip(shrink(premultiplied, *size).round(), 0, 255).astype(np.uint8)
    return image if image.shape[:2] == size[::-1] else shrink(image, *size)


def read_matted(frame: PosedFrame, background: Background) -> UInt8[np.ndarray, "h w c"]:
    """The frame's picture at full size, its look applied; before a plain background its matte is the alpha."""
    image = _looked(frame, read_pixels(frame.path))
    if frame.matte is None or background == "shell":
        return image
    return np.concatenate([image[..., :3], read_matte(frame.matte, image.shape[:2])[..., None]], axis=2)


def read_opacity(frame: PosedFrame, background: Background) -> UInt8[np.ndarray, "h w"] | None:
    """The frame's matte before a plain background, else the alpha of its picture; None where it has neither."""
    if frame.matte is not None and background != "shell":
        return read_matte(frame.matte, (frame.camera.height, frame.camera.width))
    image = read_pixels(frame.path)
    return np.ascontiguousarray(image[..., 3]) if image.shape[2] == 4 else None


def read_matte(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """A frame's matte, 255 is the subject.

    Args:
        path: Its file.
        size: Height and width of the picture.
    Raises:
        CaptureError: It cannot be read, or has another size.
    """
    matte = read_pixels(path)[..., 0]
    if matte.shape != size:
        wrong = f"{path}: matte is {matte.shape[1]}x{matte.shape[0]}, its picture {size[1]}x{size[0]}"
        raise CaptureError("matte-size-wrong", f"{wrong}; save it at the picture's size")
    return matte


def _looked(frame: PosedFrame, image: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    """A frame's picture with its look applied, in place."""
    if frame.look is not None:
        image[..., :3] = frame.look.apply(image[..., :3])
    return image


def image_scale_for(width: int, height: int, max_pixels: int) -> float:
    """Relative size at which a picture has at most `max_pixels` pixels; never enlarges."""
    return min(1.0, float(np.sqrt(max_pixels / (width * height))))


def _is_similarity(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a matrix turns, moves and scales, and nothing else."""
    if not np.isfinite(matrix).all() or (det := np.linalg.det(matrix[:3, :3])) <= 0:
        return False
    R = matrix[:3, :3] / np.cbrt(det)
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= RIGID_TOLERANCE and (matrix[3] == [0, 0, 0, 1]).all())
