"""Damage behind a stage: cameras, clocks, flow, box and mattes that are wrong and sure of themselves."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from devrf.calibration.rigs.rig import read_rig
from devrf.capture.camera import Camera
from devrf.capture.frames import FrameSet
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import PosedFrame, Scene
from devrf.flow.store import read_checks, read_pair, write_pair
from devrf.lab.bench.stability.damage.intact import Damage, DoesNotApply, Intact, behind_scene
from devrf.lab.simulate.session.damage import pierced, turned, with_smaller_box, zoomed
from devrf.pipelines.stage import StageContext

Flow = Float32[np.ndarray, "height width 2"]


def turned_cameras(intact: Intact) -> Damage:
    """Every training camera turned by so many degrees about its own centre, each around its own random axis."""
    return _wrong_cameras(intact, lambda camera, rng: turned(camera, intact.severity, rng))


def wrong_focal_lengths(intact: Intact) -> Damage:
    """The focal lengths of all training cameras too long by so many percent."""
    return _wrong_cameras(intact, lambda camera, rng: zoomed(camera, 1 + intact.share))


def late_clock(intact: Intact) -> Damage:
    """The clock of the last training camera off by so many frames, and sure of itself."""
    return _wrong_clock(intact, lambda times_s: (intact.severity * _step(times_s), 0.0))


def drifting_clock(intact: Intact) -> Damage:
    """The clock of the last training camera right at its first frame, and so many frames off at its last."""

    def drift(times_s: np.ndarray) -> tuple[float, float]:
        too_fast = intact.severity * _step(times_s) / float(np.ptp(times_s))
        return -too_fast * float(times_s[0]), too_fast

    return _wrong_clock(intact, drift)


def reversed_flow(intact: Intact) -> Damage:
    """So many percent of the pairs of pictures, drawn at random, with their flow the other way round."""
    return _wrong_flow(intact, intact.share, lambda flow, rng: -flow)


def zeroed_flow(intact: Intact) -> Damage:
    """So many percent of the pairs of pictures, drawn at random, with flow that says that nothing moves."""
    return _wrong_flow(intact, intact.share, lambda flow, rng: np.zeros_like(flow))


def noisy_flow(intact: Intact) -> Damage:
    """Every vector of the flow off by a normal error of so many percent of the picture's width, each by its own."""

    def shake(flow: Flow, rng: np.random.Generator) -> Flow:
        scale = intact.share * flow.shape[1]
        return flow + scale * rng.standard_normal(flow.shape, dtype=np.float32)

    return _wrong_flow(intact, 1.0, shake)


def small_box(intact: Intact) -> Damage:
    """The sides of the box shorter by so many percent, its middle where it was."""
    return behind_scene(intact, lambda scene: with_smaller_box(scene, 1 - intact.share))


def mattes_with_holes(intact: Intact) -> Damage:
    """Round holes in the subject's matte, so many percent of it, elsewhere in every picture that is trained on."""
    train = [frame for frame in intact.scene.frames if frame.split == "train"]
    if any(read_pixels(frame.path).shape[2] != 4 for frame in (train[0], train[-1])):
        raise DoesNotApply("pictures-without-alpha", "its pictures carry no alpha")

    def spoil(scene: Scene) -> Scene:
        rng, folder = intact.rng, intact.folder / "pictures"
        folder.mkdir(exist_ok=True)

        def spoilt(number: int, frame: PosedFrame) -> PosedFrame:
            if frame.split == "test":
                return frame
            picture = read_pixels(frame.path)
            picture[..., 3] = pierced(picture[..., 3], intact.share, rng)
            path = folder / f"{number:06d}.png"
            write_png(path, picture)
            return replace(frame, path=path)

        frames = [spoilt(n, frame) for n, frame in enumerate(scene.frames)]
        at_rest = len(scene.static)
        return replace(scene, static=tuple(frames[:at_rest]), dynamic=tuple(frames[at_rest:]))

    return behind_scene(intact, spoil)


def _step(times_s: np.ndarray) -> float:
    """From one picture to the next."""
    return float(np.median(np.diff(times_s)))


def _wrong_clock(intact: Intact, error: Callable[[np.ndarray], tuple[float, float]]) -> Damage:
    """The last training camera's clock changed: behind stage `sync` of a capture, behind stage `scene` of a data set.

    Args:
        intact: What is damaged.
        error: Given the times of the camera's pictures: by how many seconds they become too late at time 0, and by how
            many more a second. Of a data set what falls behind its last time is left out.
    """
    name = intact.cameras[-1]

    def in_sync(context: StageContext) -> None:
        path = context.out / "sync.json"
        content = json.loads(path.read_text())
        frames = FrameSet.read(context.run_dir / "ingest").moving[name].used
        late_s, faster = error(np.array([f.time_s for f in frames if f.time_s is not None]))
        clock = content["cameras"][name]
        clock["offset_s"] += late_s
        clock["drift_ppm"] += 1e6 * faster
        path.write_text(json.dumps(content, indent=1))

    def in_scene(scene: Scene) -> Scene:
        of_camera = [f.time_s for f in scene.dynamic if f.camera_name == name and f.time_s is not None]
        late_s, faster = error(np.unique(of_camera))
        frames = []
        for frame in scene.dynamic:
            if frame.camera_name == name and frame.time_s is not None:
                told_s = frame.time_s + late_s + faster * frame.time_s
                if told_s > scene.t1_s:
                    continue
                frame = replace(frame, time_s=told_s, time=(told_s - scene.t0_s) / (scene.t1_s - scene.t0_s))
            frames.append(frame)
        return replace(scene, dynamic=tuple(frames))

    return (
        behind_scene(intact, in_scene) if intact.capture is None else Damage(intact.config, "sync", in_sync)
    )


def _wrong_flow(intact: Intact, share: float, change: Callable[[Flow, np.random.Generator], Flow]) -> Damage:
    """The flow of a share of the pairs, drawn at random, changed where it is trusted."""

    def spoil(context: StageContext) -> None:
        pairs, rng = sorted(context.out.glob("*/*.npz")), intact.rng
        for n in rng.choice(len(pairs), round(share * len(pairs)), replace=False):
            flow, confidence = read_pair(pairs[n])
            write_pair(pairs[n], change(flow.astype(np.float32), rng), confidence, read_checks(pairs[n]))

    return Damage(intact.config, "flow", spoil)


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
        path: Path = context.out / "rig.json"
        content = json.loads(path.read_text())  # not by `read_rig`: what only the report reads would be lost
        cameras = read_rig(path).cameras
        for name, rng in generators().items():
            wrong = change(cameras[name].camera, rng)
            content["cameras"][name] |= {
                "K": wrong.K.tolist(),
                "cam_from_world": wrong.cam_from_world.tolist(),
            }
        path.write_text(json.dumps(content, indent=1))

    return behind_scene(intact, in_scene) if intact.capture is None else Damage(intact.config, "rig", in_rig)
