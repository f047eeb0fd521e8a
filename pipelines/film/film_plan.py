"""From what was asked to a film: which options can be, and a camera and a time for every picture."""

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.formats.geometry.camera_path import CameraPath, read_camera_path
from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.words import unknown_word
from devrf.reconstruct.film.times import parse_time
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import PATHS, through

LAYERS, FORMATS = ("colour", "depth"), ("mp4", "png")
SIDE_PX = (16, 8192)  # least and most of a picture
FPS = (0.1, 240.0)
USUAL_FPS = 24.0
MOST_S = 3600.0
MOST_PICTURES = 20_000
STANDING_S = 4.0  # length of a film in which time stands still, where none is named
OTHER_SHAPE = 0.02  # by which the size of a camera that stands may differ from its pictures' shape


@dataclass(frozen=True)
class FilmRequest:
    """The options of a film as typed; what was not asked for is None."""

    path: str | None = None
    time: str | None = None
    seconds: float | None = None
    fps: float | None = None
    size: str | None = None
    layers: str | None = None
    without: str | None = None
    format: str | None = None
    out: Path | None = None

    @property
    def nothing(self) -> bool:
        """Whether no option was given."""
        return self == FilmRequest()

    @property
    def name(self) -> str:
        """A name for the film's folder that other options do not give."""
        words = [Path(self.path).stem if self.path and self.path.endswith(".json") else self.path or "orbit"]
        for key in (field.name for field in fields(self) if field.name not in ("path", "out")):
            if (value := getattr(self, key)) is not None:
                words += [key, f"{value:g}" if isinstance(value, float) else value]
        return re.sub(r"[^\w.+-]+", "-", "-".join(words)).strip("-.")[:120] or "film"

    def check(self) -> None:
        """Refuse what is no film.

        Raises:
            InputError: With the option, its value and what is expected.
        """
        for key, low, high in (("seconds", 0.0, MOST_S), ("fps", *FPS)):
            value = getattr(self, key)
            if value is not None and not low <= value <= high or value == 0:
                least = "more than 0" if low == 0 else f"at least {low:g}"
                text = f"--{key} {value:g}: expected {least} and at most {high:g}"
                raise InputError("option-out-of-range", text)
        if (self.format or "mp4") not in FORMATS:
            raise unknown_word("--format", str(self.format), FORMATS)
        self.size_px()
        self.layer_names()
        self.left_out()

    def size_px(self) -> tuple[int, int] | None:
        """Width and height.

        Raises:
            InputError: Not a size, or one that cannot be made.
        """
        if self.size is None:
            return None
        match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", self.size.strip())
        if match is None:
            text = f"--size {self.size}: expected WIDTHxHEIGHT, such as 640x360"
            raise InputError("option-malformed", text)
        width, height = int(match[1]), int(match[2])
        least, most = SIDE_PX
        if not (least <= width <= most and least <= height <= most):
            text = f"--size {self.size}: expected sides of {least} to {most} pixels"
            raise InputError("option-out-of-range", text)
        if self.format != "png" and (width % 2 or height % 2):
            raise InputError(
                "film-sides-odd",
                f"--size {self.size}: H.264 needs even sides; take {width - width % 2}x{height - height % 2}, or "
                "--format png",
            )
        return width, height

    def layer_names(self) -> tuple[str, ...]:
        """The layers, in the order of `LAYERS`.

        Raises:
            InputError: One of them is unknown.
        """
        asked = {word.strip() for word in (self.layers or "colour").split(",")}
        for layer in sorted(asked - set(LAYERS)):
            raise unknown_word("--layers", layer, LAYERS)
        return tuple(layer for layer in LAYERS if layer in asked)

    def left_out(self) -> tuple[int, ...]:
        """Rigid parts that are not shown, counted from 1.

        Raises:
            InputError: Not numbers.
        """
        words = [] if self.without is None else [word.strip() for word in self.without.split(",")]
        if not all(re.fullmatch(r"0*[1-9]\d{0,2}", word) for word in words):
            text = f"--without {self.without}: expected numbers of parts, such as 2 or 1,3 (the report lists them)"
            raise InputError("option-malformed", text)
        return tuple(sorted({int(word) for word in words}))


@dataclass(frozen=True)
class Plan:
    """Cameras (in the box frame) and times (in [0, 1]; None: at rest) of a film's pictures, and how many a second."""

    cameras: tuple[Camera, ...]
    times: tuple[float | None, ...]
    fps: float


def planned(asked: FilmRequest, world: Scene, moves: bool, most_pixels: int) -> Plan:
    """Find the cameras and times.

    Args:
        asked: Checked options.
        world: The scene in its world.
        moves: Whether the model moves.
        most_pixels: Of a picture, where no size is asked for.
    Raises:
        InputError: What was asked for does not fit this scene.
    """
    scene, spoken = world.in_box_frame(), asked.path or "orbit"
    cameras = film_cameras(scene)
    lens = film_lens(cameras, most_pixels, asked.size_px())
    if asked.time is not None and not moves:
        raise InputError(
            "scene-without-motion",
            "--time: there is no motion in this run (nothing moves, or stage deformation is not made yet); a film of "
            "it shows the scene at rest, without times",
        )
    given = _from_file(asked, spoken, lens)
    fps = asked.fps or (given.fps if given is not None and given.fps else None) or USUAL_FPS
    times = _times(asked, scene, moves, fps, given)
    if given is not None:
        path = _through(given, world, len(times))
    elif spoken in PATHS:
        path = PATHS[spoken](cameras, scene.aabb, len(times), lens)
    elif spoken.startswith("still:"):
        path = [_still(scene, spoken.partition(":")[2], asked)] * len(times)
    else:
        raise unknown_word("--path", spoken.partition(":")[0], (*PATHS, "still:CAMERA", "FILE.json"))
    return Plan(tuple(path), times, fps)


def _from_file(asked: FilmRequest, spoken: str, lens: Camera) -> CameraPath | None:
    path = Path(spoken).expanduser()
    if path.suffix.lower() != ".json" and not path.is_file():
        return None
    if not path.is_file():
        raise InputError("file-missing", f"--path {spoken}: no such file")
    given = read_camera_path(path, asked.size_px(), (lens.width, lens.height))
    if asked.size is None:  # the file's own size is held to the same bounds
        width, height = given.cameras[0].width, given.cameras[0].height
        try:
            replace(asked, size=f"{width}x{height}").size_px()
        except InputError as error:
            raise InputError(error.code, f"{path}: render_width and render_height, as {error}") from None
    return given


def _times(
    asked: FilmRequest, scene: Scene, moves: bool, fps: float, given: CameraPath | None
) -> tuple[float | None, ...]:
    """Of each picture: as it was, or all of the clip in `--seconds`, or as the file says, or one time throughout."""
    seconds, clip_s = asked.seconds, scene.t1_s - scene.t0_s
    if seconds is None and given is not None:
        lasts = len(given.cameras) / fps if given.every_picture else given.seconds
        seconds = lasts or float(max(len(given.cameras) - 1, 1))
    if not moves or asked.time is not None:
        time = None if asked.time is None else parse_time(asked.time, "--time", scene.t0_s, scene.t1_s)
        return (time,) * _count((seconds or STANDING_S) * fps)
    if seconds is None:  # to the end, where nothing follows
        count = _count(np.floor(clip_s * fps + 1e-6) + 1)
        return tuple(np.minimum(np.arange(count) / (fps * max(clip_s, 1e-9)), 1.0).tolist())
    count = _count(seconds * fps)
    if given is None or given.times is None:
        return tuple(np.linspace(0.0, 1.0, count).tolist())
    knots = [*given.times, *(given.times[:1] if given.closed else ())]
    return tuple(np.interp(_places(given, count, len(knots)), np.arange(len(knots)), knots).tolist())


def _count(pictures: float) -> int:
    count = max(1, round(pictures))
    if count > MOST_PICTURES:
        wrong = f"the film would have {count} pictures, at most {MOST_PICTURES} are made"
        raise InputError("film-too-long", f"{wrong}; choose fewer --seconds or --fps")
    return count


def _through(given: CameraPath, world: Scene, count: int) -> list[Camera]:
    """The file's path in the box frame, with so many pictures."""
    views = [camera.moved(world.box_from_world) for camera in given.cameras]
    if given.every_picture and count == len(views):
        return views
    views += views[:1] if given.closed else []
    return through(views, _places(given, count, len(views)))


def _places(given: CameraPath, count: int, knots: int) -> np.ndarray:
    """Where each picture lies among the file's views [count]."""
    return np.linspace(0, knots - 1, count, endpoint=not given.closed)


def _still(scene: Scene, name: str, asked: FilmRequest) -> Camera:
    """A camera that stands still, with its own lens, at the size that it is tested at or that was asked for."""
    known = {f.camera_name: f.camera for f in scene.dynamic}
    if name not in known:
        text = f"--path still:{name}: no such camera; expected one of {', '.join(known) or 'none'}"
        raise InputError("camera-unknown", text)
    camera, size = known[name], asked.size_px()
    if size is None:
        return camera.scaled(scene.image_scale)
    fitting = round(size[0] * camera.height / camera.width)
    if abs(size[1] - fitting) > max(1, OTHER_SHAPE * fitting):
        raise InputError(
            "film-other-shape",
            f"--size {asked.size}: pictures of {name} are {camera.width}x{camera.height}; take "
            f"{size[0]}x{fitting + fitting % 2} for its shape",
        )
    K = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0]) @ camera.K
    return replace(camera, width=size[0], height=size[1], K=K)
