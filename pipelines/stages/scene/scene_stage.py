"""Stage `scene`: pictures, cameras, exact times and the box, in one place for everything that follows."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from devrf.capture.formats.parts.scene_files import write_scene
from devrf.capture.measure import Measure, noted
from devrf.capture.scene import PosedFrame, Scene, image_scale_for
from devrf.capture.view_axes import behind
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.inputs.configured_dataset import configured_dataset
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.sampling.pictures import training

if TYPE_CHECKING:
    from devrf.calibration.extent.bounds import Bounds

# per picture, where image_scale is not set
MAX_PIXELS = {"tiny": 64_000, "fast": 400_000, "reference": 10**9}
MOST_BEHIND = 0.01  # of the sightings of points; structure from motion leaves fewer wrong ones
MOST_AWAY = 0.5  # of the cameras; turned axes turn them all
# Where voxels are larger a smaller box is sharper (2.5 and 2.6 pixels: held-out sweep + 0.2 and + 1.2 dB); where they
# are smaller, what it leaves outside gets coarser (1.47 pixels: - 1.7 dB).
PIXELS_A_VOXEL = 1.5
FEW_FRAMES = 5  # of a training camera: named in the remedy


def run(context: StageContext) -> None:
    """Write `scene.json`, `static/transforms.json`, `dynamic/transforms.json` and `points.npz`."""
    config = context.config
    if config.dataset is not None:
        scene = _from_dataset(context)
    else:
        from devrf.pipelines.stages.scene.captured_scene import (
            scene_from_capture,  # a data set needs no vision library
        )

        scene, bounds = scene_from_capture(context, lambda frames: widths_of_box(config, frames))
        context.measures += health(bounds, scene)
    trained = training(scene.frames) or scene.frames
    scene = replace(scene, image_scale=auto_image_scale(config, trained))
    write_scene(context.out, scene)
    files = (file for f in scene.frames for file in (f.path, f.matte, f.flow) if file is not None)
    context.referred += [file for file in files if not file.is_relative_to(context.out)]


def auto_image_scale(config: SceneConfig, frames: tuple[PosedFrame, ...]) -> float:
    """`reconstruct.image_scale`, else as large as the preset's budget of pixels allows."""
    if config.reconstruct.image_scale is not None:
        return config.reconstruct.image_scale
    largest = max((f.camera for f in frames), key=lambda c: c.width * c.height)
    return image_scale_for(largest.width, largest.height, MAX_PIXELS[config.preset])


def widths_of_box(config: SceneConfig, frames: tuple[PosedFrame, ...]) -> float:
    """Widths of a picture that a mean side of the box may be long for its voxels to be as fine as the pictures need."""
    from devrf.reconstruct.options import PRESETS

    resolution = config.reconstruct.resolution or PRESETS[config.preset].canonical.resolution
    widest = max(f.camera.width for f in frames)
    return PIXELS_A_VOXEL * resolution / (auto_image_scale(config, frames) * widest)


def _from_dataset(context: StageContext) -> Scene:
    """A finished data set; its sparse points, where it has any, give the box."""
    notes: list[str] = []
    scene = configured_dataset(context.config, context.scene_dir, notes)
    context.measures += noted(notes, "data set")
    context.measures += _views(scene)
    if scene.points is None:
        return scene
    from devrf.calibration.extent.bounds import scene_bounds
    from devrf.pipelines.health.box_rows import box_measures

    start, end = scene.points.lines_of_sight(scene.static)
    bounds = scene_bounds(
        [f.camera for f in scene.static], [], scene.points.xyz, np.linalg.norm(end - start, axis=1)
    )
    context.measures += health(bounds, scene)
    context.measures += box_measures(bounds, {}, None, scene.dynamic, scene.static)
    return replace(
        scene,
        box_from_world=bounds.box_from_world,
        aabb=bounds.aabb,
        near=bounds.near,
        far=bounds.far,
        kind=bounds.kind,
    )


def _views(scene: Scene) -> Iterator[Measure]:
    """Whether the cameras of a data set look at what they show: others write axes down in many ways.

    The axes of forward-facing sets run side by side and meet anywhere.
    """
    if scene.points is None and (scene.kind == "forward" or len(scene.static) < 2):
        return
    if scene.points is None:
        about, most = "cameras that look away from where their view axes meet", MOST_AWAY
    else:
        about, most = "sightings of sparse points behind their cameras", MOST_BEHIND
    share = behind([frame.camera for frame in scene.static], scene.points)
    yield Measure("poses-turned", 100 * share, about, warn=100 * most)


def health(bounds: "Bounds", scene: Scene) -> Iterator[Measure]:
    """The time that is modelled, and whether the box is more than a guess."""
    if scene.dynamic:
        moving = {f.camera_name for f in scene.dynamic if f.split == "train"}
        counts = {name: sum(f.camera_name == name for f in scene.dynamic) for name in sorted(moving)}
        few = ", ".join(f"{name} {count}" for name, count in counts.items() if count < FEW_FRAMES)
        yield Measure("scene-few-frames", min(counts.values(), default=0), facts={"few": few})
        if "hull" not in bounds.basis:
            yield Measure("box-unexplained", "nothing is seen to move in two cameras at once", why="guess")
