"""From what was asked to a film: a camera and a time for every picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.errors import InputError
from devrf.capture.formats.camera_path import CameraPath, read_camera_path
from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.config.words import suggestion
from devrf.pipelines.film.asked import USUAL_FPS, USUAL_SLOW, Asked, option
from devrf.reconstruct.film.between import between, through, views_of
from devrf.reconstruct.film.paths import PATHS
from devrf.reconstruct.film.span import Span, film_cameras, film_lens
from devrf.reconstruct.film.times import STANDING_S, TimeCurve, parse_time, picture_count

MOST_PICTURES = 20_000
MOST_ANIMATED = 500  # in one animated picture: the encoder has all of them open
OTHER_SHAPE = 0.02  # by which the size of a camera that stands may differ from its pictures' shape


@dataclass(frozen=True)
class Film:
    """A film to make.

    Attributes:
        scene: In the box frame.
        path: What was asked of the path.
        cameras: Of every picture, in the box frame.
        times: Of every picture in [0, 1]; None where the scene is at rest.
        fps: Pictures a second.
        layers: What is shown, of `asked.LAYERS`.
        format: One of `asked.FORMATS`.
        beside: The true picture beside each, or none.
        without: Rigid parts that are not shown, counted from 1.
    """

    scene: Scene
    path: str
    cameras: tuple[Camera, ...]
    times: tuple[float | None, ...]
    fps: float
    layers: tuple[str, ...]
    format: str
    beside: tuple[PosedFrame, ...] = ()
    without: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """Number of pictures."""
        return len(self.cameras)


def planned(asked: Asked, world: Scene, moves: bool, most_pixels: int) -> Film:
    """Find the cameras and times.

    Args:
        asked: Checked options.
        world: The scene in its world.
        moves: Whether the model moves.
        most_pixels: Of a picture, where no size is asked for.
    Raises:
        InputError: What was asked for does not fit this scene.
    """
    scene = world.in_box_frame()
    spoken = asked.path or "orbit"
    cameras = film_cameras(scene)
    lens = film_lens(cameras, most_pixels, asked.size_px())
    if not moves:
        _refuse_times(asked)
    given = _from_file(asked, spoken, lens)
    fps = asked.fps or (given.fps if given is not None and given.fps else None) or USUAL_FPS
    count, times = _times(asked, scene, moves, fps, given)
    if given is not None:
        path = _through(given, world, count)
    elif spoken in PATHS:
        path = PATHS[spoken](cameras, scene.aabb, count, lens)
    elif spoken == "between" or spoken.startswith("between:"):
        names = [name for name in spoken.partition(":")[2].split(",") if name]
        views = views_of(scene, names)
        closed = not names and Span.of(views, scene.aabb).closed
        path = between(views, scene.aabb, count, lens, closed)
    elif spoken.startswith("still:"):
        path = [_still(scene, spoken.partition(":")[2], asked)] * count
    else:
        raise _unknown(spoken)
    film = Film(
        scene,
        spoken,
        tuple(path),
        times,
        fps,
        asked.layer_names(),
        asked.format or "mp4",
        without=asked.left_out(),
    )
    if film.format == "webp" and film.count > MOST_ANIMATED:
        raise InputError(
            "film-too-long",
            f"--format webp: {film.count} pictures, at most {MOST_ANIMATED} are put into one; choose fewer --seconds "
            "or --fps, or mp4",
        )
    return film if asked.beside is None else _with_true(film, asked.beside)


def _from_file(asked: Asked, spoken: str, lens: Camera) -> CameraPath | None:
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
    asked: Asked, scene: Scene, moves: bool, fps: float, given: CameraPath | None
) -> tuple[int, tuple[float | None, ...]]:
    """Number of pictures and the time of each."""
    t0_s, t1_s = scene.t0_s, scene.t1_s
    seconds = asked.seconds
    if seconds is None and given is not None:
        lasts = len(given.cameras) / fps if given.every_picture else given.seconds
        seconds = lasts or float(max(len(given.cameras) - 1, 1))
    if not moves or asked.time is not None:
        count = _checked(picture_count(seconds or STANDING_S, fps, False))
        time = None if asked.time is None else parse_time(asked.time, "--time", t0_s, t1_s)
        return count, (time,) * count
    if given is not None and given.times is not None and not asked.running:
        count = _checked(picture_count(seconds or 1.0, fps, False))
        knots = [*given.times, *(given.times[:1] if given.closed else ())]
        times = np.interp(_places(given, count, len(knots)), np.arange(len(knots)), knots)
        return count, tuple(times.tolist())
    curve = _curve(asked, t0_s, t1_s)
    one_way = seconds is None and not curve.ping_pong
    count = _checked(picture_count(curve.natural_s() if seconds is None else seconds, fps, one_way))
    if one_way and curve.speed is None:
        curve = replace(curve, speed=1.0)
    return count, tuple(curve.times(count, fps).tolist())


def _curve(asked: Asked, t0_s: float, t1_s: float) -> TimeCurve:
    begin = 0.0 if asked.begin is None else parse_time(asked.begin, "--from", t0_s, t1_s)
    end = 1.0 if asked.end is None else parse_time(asked.end, "--to", t0_s, t1_s)
    if begin >= end:
        text = f"--from {asked.begin or 0} --to {asked.end or 1}: the second is not after the first"
        raise InputError("times-reversed", text)
    texts = asked.slow_texts()
    slow = None
    if texts is not None:
        first, last = (parse_time(text, "--slow", t0_s, t1_s) for text in texts)
        if first >= last:
            raise InputError("times-reversed", f"--slow {asked.slow}: the second time is not after the first")
        slow = (first, last)
    speed = USUAL_SLOW if slow is not None and asked.speed is None else asked.speed
    return TimeCurve(t1_s - t0_s, begin, end, speed, slow, bool(asked.ping_pong))


def _refuse_times(asked: Asked) -> None:
    options = [*asked.running, *(["time"] if asked.time is not None else [])]
    if options:
        raise InputError(
            "scene-without-motion",
            f"{option(options[0])}: there is no motion in this run (nothing moves, or stage "
            "deformation is not made yet); a film of it shows the scene at rest, without times",
        )


def _through(given: CameraPath, world: Scene, count: int) -> list[Camera]:
    """The file's path in the box frame, with so many pictures."""
    views = [camera.moved(world.box_from_world) for camera in given.cameras]
    if given.every_picture and count == len(views):
        return views
    views += views[:1] if given.closed else []
    return through(views, np.arange(len(views), dtype=np.float64), _places(given, count, len(views)))


def _places(given: CameraPath, count: int, knots: int) -> np.ndarray:
    """Where each picture lies among the file's views."""
    return np.linspace(0, knots - 1, count, endpoint=not given.closed)


def _still(scene: Scene, name: str, asked: Asked) -> Camera:
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


def _with_true(film: Film, name: str) -> Film:
    """The film with the true pictures of a camera; one that stands where that camera does takes their times."""
    frames = sorted((f for f in film.scene.dynamic if f.camera_name == name), key=lambda f: f.time or 0.0)
    if not frames or any(time is None for time in film.times):
        names = sorted({f.camera_name for f in film.scene.dynamic})
        text = f"--beside {name}: no such camera in motion; expected one of {', '.join(names) or 'none'}"
        raise InputError("camera-unknown", text)
    at = np.array([f.time for f in frames], dtype=np.float64)
    nearest = [int(np.abs(at - time).argmin()) for time in film.times if time is not None]
    beside = tuple(frames[n] for n in nearest)
    if film.path == f"still:{name}":
        return replace(film, beside=beside, times=tuple(f.time for f in beside))
    return replace(film, beside=beside)


def _checked(count: int) -> int:
    if count > MOST_PICTURES:
        raise InputError(
            "film-too-long",
            f"the film would have {count} pictures, at most {MOST_PICTURES} are made; choose fewer --seconds or --fps",
        )
    return count


def _unknown(spoken: str) -> InputError:
    known: Sequence[str] = (*PATHS, "between", "between:CAMERA,CAMERA", "still:CAMERA", "FILE.json")
    return InputError(
        "option-unknown-value", f"--path {spoken}: expected {', '.join(known)}{suggestion(spoken, known)}"
    )
