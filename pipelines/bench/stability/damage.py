"""What each axis does to a scene. Damage gets in before the run or behind one stage of it.

Before: another configuration, whose raw files may be written anew into the case's folder. Behind a stage: what the
stage left is read, damaged and written over, so that all that follows works on it, and the stage's own health rows,
made before, know nothing of it. A function here is given what is to be damaged and says how; it raises
`DoesNotApply` where its damage means nothing for such a scene.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from devrf.calibration.rigs.rig import read_rig
from devrf.capture.camera import Camera
from devrf.capture.errors import DevrfError
from devrf.capture.formats.scene_files import read_scene, write_scene
from devrf.capture.frames import FrameSet
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.simulate.damage import Picture, blurred, turned, with_smaller_box, write_again, zoomed
from devrf.flow.store import read_checks, read_pair, write_pair
from devrf.pipelines.config.scene import CaptureConfig, SceneConfig
from devrf.pipelines.stage import StageContext

SEEDS_APART = 1000  # more than anyone repeats a case


class DoesNotApply(DevrfError):
    """A damage that means nothing for a scene."""


@dataclass(frozen=True)
class Intact:
    """What is to be damaged.

    Attributes:
        config: Of the undisturbed case, with the case's seed.
        scene_dir: Folder of scene.yaml.
        scene: What the undisturbed case made of it.
        folder: Of the case, for files that are written anew.
        severity: How much, in the axis' unit.
        seed: Of what is drawn at random.
    """

    config: SceneConfig
    scene_dir: Path
    scene: Scene
    folder: Path
    severity: float
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        """A generator at its beginning."""
        return np.random.default_rng(self.seed)

    @property
    def capture(self) -> CaptureConfig | None:
        """The raw files; None of a data set."""
        return self.config.capture

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the training cameras."""
        return tuple(dict.fromkeys(f.camera_name for f in self.scene.dynamic if f.split == "train"))


@dataclass(frozen=True)
class Damage:
    """What is different in a case.

    Attributes:
        config: Its configuration.
        stage: The stage behind which damage is done; None: nowhere.
        behind: Does it, given what the stage was given.
    """

    config: SceneConfig
    stage: str | None = None
    behind: Callable[[StageContext], None] = lambda context: None


Damaging = Callable[[Intact], Damage]


def fewer_cameras(intact: Intact) -> Damage:
    """So many training cameras left out, those that stay spread over all."""
    count = len(intact.cameras) - int(intact.severity)
    if count < 1:
        raise DoesNotApply(f"there are {len(intact.cameras)} training cameras")
    last = len(intact.cameras) - 1
    keep = [intact.cameras[n] for n in np.linspace(0, last, count).round().astype(int)]
    capture = intact.capture
    if capture is not None:
        cameras = {n: c for n, c in capture.cameras.items() if n in keep or n in capture.test_names}
        return Damage(_with_capture(intact.config, cameras=cameras))

    def without(scene: Scene) -> Scene:
        dynamic = tuple(f for f in scene.dynamic if f.split == "test" or f.camera_name in keep)
        return replace(scene, dynamic=dynamic)

    return _behind_scene(intact, without)


def fewer_sweep_pictures(intact: Intact) -> Damage:
    """Only every n-th picture of the sweep's clip; of a data set's pictures at rest."""
    every = int(intact.severity)
    if intact.capture is None:
        if intact.scene.points is not None:
            raise DoesNotApply("the sparse points of a data set name its pictures by their places")
        return _behind_scene(intact, lambda scene: _with_every(scene, every))
    config = _with_sweep(intact, lambda old, new: write_again(old, new, every))
    truth = intact.config.truth_path(intact.scene_dir)
    if truth is None:
        return Damage(config)
    content = json.loads(truth.read_text())
    content["static"] = (content.get("static") or [])[::every]
    fewer = intact.folder / "ground_truth.json"
    fewer.write_text(json.dumps(content))
    evaluate = config.evaluate.model_copy(update={"truth": str(fewer)})
    return Damage(config.model_copy(update={"evaluate": evaluate}))


def blurred_sweep(intact: Intact) -> Damage:
    """All pictures of the sweep's clip blurred sideways by so many percent of their width."""
    share = intact.severity / 100

    def blur(picture: Picture) -> Picture:
        return blurred(picture, share)

    return Damage(_with_sweep(intact, lambda old, new: write_again(old, new, change=blur)))


def turned_cameras(intact: Intact) -> Damage:
    """Every training camera turned by so many degrees about its own centre, each around its own random axis."""
    return _wrong_cameras(intact, lambda camera, rng: turned(camera, intact.severity, rng))


def wrong_focal_lengths(intact: Intact) -> Damage:
    """The focal lengths of all training cameras too long by so many percent."""
    return _wrong_cameras(intact, lambda camera, rng: zoomed(camera, 1 + intact.severity / 100))


def late_clock(intact: Intact) -> Damage:
    """The clock of the last training camera off by so many frames, and sure of itself."""
    if intact.capture is None:
        raise DoesNotApply("a data set has times, and no clocks")
    name = intact.cameras[-1]

    def shift(context: StageContext) -> None:
        path = context.out / "sync.json"
        content = json.loads(path.read_text())
        frames = FrameSet.read(context.run_dir / "ingest").moving[name].used
        step_s = float(np.median(np.diff([f.time_s for f in frames if f.time_s is not None])))
        content["cameras"][name]["offset_s"] += intact.severity * step_s
        path.write_text(json.dumps(content, indent=1))

    return Damage(intact.config, "sync", shift)


def reversed_flow(intact: Intact) -> Damage:
    """So many percent of the pairs of pictures, drawn at random, with their flow the other way round."""

    def reverse(context: StageContext) -> None:
        pairs = sorted(context.out.glob("*/*.npz"))
        count = round(intact.severity / 100 * len(pairs))
        for n in intact.rng.choice(len(pairs), count, replace=False):
            flow, confidence = read_pair(pairs[n])
            write_pair(pairs[n], -flow.astype(np.float32), confidence, read_checks(pairs[n]))

    return Damage(intact.config, "flow", reverse)


def small_box(intact: Intact) -> Damage:
    """The sides of the box shorter by so many percent, its middle where it was."""
    share = 1 - intact.severity / 100
    return _behind_scene(intact, lambda scene: with_smaller_box(scene, share))


def learning_rate(intact: Intact) -> Damage:
    """The learning rates of both trainings multiplied."""
    return Damage(_with_reconstruct(intact.config, learning_rate=intact.severity))


def other_seed(intact: Intact) -> Damage:
    """Nothing but another seed of the trainings."""
    return Damage(_with_reconstruct(intact.config, seed=SEEDS_APART * int(intact.severity) + intact.seed))


def _with_capture(config: SceneConfig, **changes: object) -> SceneConfig:
    assert config.capture is not None  # checked by the callers
    return config.model_copy(update={"capture": config.capture.model_copy(update=changes)})


def _with_reconstruct(config: SceneConfig, **changes: object) -> SceneConfig:
    return config.model_copy(update={"reconstruct": config.reconstruct.model_copy(update=changes)})


def _with_sweep(intact: Intact, write: Callable[[Path, Path], None]) -> SceneConfig:
    """The sweep's clip written anew, each time: the same bytes, if nothing has changed."""
    capture = intact.capture
    if capture is None or capture.static is None:
        raise DoesNotApply("a data set brings no clip of its sweep")
    source = intact.config.path(intact.scene_dir, capture.static)
    if source.is_dir():
        raise DoesNotApply("the sweep is a folder of photos, expected a clip")
    target = intact.folder / "static.mp4"
    write(source, target)
    return _with_capture(intact.config, static=str(target))


def _wrong_cameras(intact: Intact, change: Callable[[Camera, np.random.Generator], Camera]) -> Damage:
    """Training cameras changed: behind stage `rig` of a capture, behind stage `scene` of a data set."""

    def generators() -> dict[str, np.random.Generator]:
        """Of every camera its own, at its beginning."""
        return dict(zip(intact.cameras, intact.rng.spawn(len(intact.cameras)), strict=True))

    def in_scene(scene: Scene) -> Scene:
        def changed(frame: PosedFrame) -> PosedFrame:
            if frame.split == "test":
                return frame
            return replace(frame, camera=change(frame.camera, generators()[frame.camera_name]))

        return replace(scene, dynamic=tuple(changed(frame) for frame in scene.dynamic))

    def in_rig(context: StageContext) -> None:
        path = context.out / "rig.json"
        content = json.loads(path.read_text())  # not by `read_rig`: what only the report reads would be lost
        cameras = read_rig(path).cameras
        for name, rng in generators().items():
            wrong = change(cameras[name].camera, rng)
            content["cameras"][name] |= {
                "K": wrong.K.tolist(),
                "cam_from_world": wrong.cam_from_world.tolist(),
            }
        path.write_text(json.dumps(content, indent=1))

    return _behind_scene(intact, in_scene) if intact.capture is None else Damage(intact.config, "rig", in_rig)


def _behind_scene(intact: Intact, change: Callable[[Scene], Scene]) -> Damage:
    return Damage(
        intact.config,
        "scene",
        lambda context: write_scene(context.out, change(read_scene(context.out))),
    )


def _with_every(scene: Scene, every: int) -> Scene:
    train = [frame.path for frame in scene.static if frame.split == "train"]
    left_out = set(train) - set(train[::every])
    return replace(scene, static=tuple(frame for frame in scene.static if frame.path not in left_out))
