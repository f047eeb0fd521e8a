"""Mattes of a capture's pictures, by the method that scene.yaml names, and what follows from them for the scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from devrf.calibration.extent.matted import SceneMattes
from devrf.calibration.extent.motion_masks import MASK_SIDE_PX
from devrf.capture.camera import Camera
from devrf.capture.frames import FrameSet
from devrf.capture.mattes.chroma import parse_colour
from devrf.capture.mattes.given import SWEEP, cameras_with_mattes
from devrf.capture.mattes.make import CameraMattes, MatteClip, chroma_mattes, given_mattes
from devrf.capture.measure import ENOUGH_CAMERAS, Measure
from devrf.capture.photos.photo_folders import list_pictures
from devrf.capture.scene import PosedFrame, by_camera
from devrf.capture.system.errors import DevrfError
from devrf.capture.system.progress import Progress, part
from devrf.pipelines.config.scene import MattesConfig
from devrf.pipelines.health.left_out import left_out
from devrf.pipelines.inputs.capture_session import raw_file
from devrf.pipelines.stage import StageContext

DOUBTFUL = (
    "the commonest strong colour of its pictures is neither a green nor a blue screen's and may be the subject; name "
    "the screen's colour (capture.mattes: {method: chroma, colour: '#00b140'})"
)
Maker = Callable[[MatteClip, Progress], CameraMattes]


def scene_mattes(
    context: StageContext,
    frames: FrameSet,
    static: tuple[PosedFrame, ...],
    dynamic: tuple[PosedFrame, ...],
    progress: Progress,
) -> SceneMattes | None:
    """Make the mattes; None where scene.yaml asks for none."""
    capture = context.config.capture
    assert capture is not None
    if capture.mattes is None:
        return None
    out = context.out / "mattes"
    clips = _clips(context, frames, static, dynamic)
    make, names = _maker(capture.mattes, context, out, list(clips))
    made: dict[str, CameraMattes] = {}
    unfound: dict[str, DevrfError] = {}
    for n, name in enumerate(names):
        try:
            made[name] = make(clips[name], part(progress, n / len(names), 1 / len(names)))
        except DevrfError as error:
            if name not in frames.tests and (name == SWEEP or error.code != "key-colour-unfound"):
                raise
            unfound[name] = error
    lost = _without_screen(frames, made, unfound)
    for name, why in lost.items():
        about = left_out(name, why) if name in frames.tests else _no_matte(name, why)
        context.measures.append(about)
    made = {name: mattes for name, mattes in made.items() if name not in lost}
    dynamic = tuple(frame for frame in dynamic if frame.camera_name not in lost)
    matte_of = {
        picture: matte
        for name, mattes in made.items()
        for picture, matte in zip(clips[name].files, mattes.files, strict=True)
    }

    def matted(of: tuple[PosedFrame, ...]) -> tuple[PosedFrame, ...]:
        return tuple(replace(f, matte=matte_of.get(f.path)) for f in of)

    shown = by_camera((*static, *dynamic))
    small = {name: [_small(frame.camera) for frame in shown.get(name, ())] for name in made}
    trained = clips.keys() - frames.tests.keys()
    everywhere = bool(static) and trained <= set(names)
    return SceneMattes(matted(static), matted(dynamic), made, small, everywhere)


def _without_screen(
    frames: FrameSet, made: dict[str, CameraMattes], unfound: dict[str, DevrfError]
) -> dict[str, str]:
    """Cameras that the scene goes on without -> why: no screen is found, or what is found may be the subject.

    Raises:
        DevrfError: That of a training camera without which too few others are left.
    """
    trained = [name for name in made if name in frames.trained]
    doubtful = [name for name in trained if made[name].doubtful_key]
    lost = {name: str(error) for name, error in unfound.items()}
    if len(trained) - len(doubtful) >= ENOUGH_CAMERAS:
        return lost | dict.fromkeys(doubtful, DOUBTFUL)
    missed = [error for name, error in unfound.items() if name in frames.trained]
    if missed and len(trained) < ENOUGH_CAMERAS:
        raise missed[0]
    return lost


def _no_matte(name: str, why: str) -> Measure:
    return Measure("camera-left-out", "no matte", name, facts={"reason": f"{why}."})


def _maker(
    mattes: MattesConfig, context: StageContext, out: Path, names: list[str]
) -> tuple[Maker, tuple[str, ...]]:
    """What makes one camera's mattes, and of which cameras."""
    if mattes.method == "chroma":
        colour = None if mattes.colour == "auto" else parse_colour(mattes.colour)
        return (lambda clip, progress: chroma_mattes(clip, colour, out, progress)), tuple(names)
    assert mattes.folder is not None
    folder = context.config.path(context.scene_dir, mattes.folder)
    inverted = None if mattes.inverted == "auto" else mattes.inverted
    found = cameras_with_mattes(folder, [name for name in names if name != SWEEP], SWEEP in names)
    return (lambda clip, progress: given_mattes(clip, folder / clip.camera, inverted, out, progress)), found


def _clips(
    context: StageContext, frames: FrameSet, static: tuple[PosedFrame, ...], dynamic: tuple[PosedFrame, ...]
) -> dict[str, MatteClip]:
    """The scene's pictures by camera, the sweep first; photos with the names they came with."""
    clips = {}
    for name, of_camera in by_camera((*static, *dynamic)).items():
        filmed = frames.cameras[name]
        photos = (
            None
            if filmed.fps_mean is not None
            else list_pictures(raw_file(context.config, context.scene_dir, name))
        )
        small = [_small(f.camera) for f in of_camera]
        re_turned = {frame.index: frame.re_turned for frame in filmed.frames}
        clips[name] = MatteClip(
            camera=name,
            files=tuple(f.path for f in of_camera),
            names={f.index: None if photos is None else photos[f.index].name for f in of_camera},
            small_sizes=tuple((camera.width, camera.height) for camera in small),
            turns=tuple(re_turned[f.index] for f in of_camera),
            count=len(filmed.frames),
        )
    return clips


def _small(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, MASK_SIDE_PX / max(camera.width, camera.height)))
