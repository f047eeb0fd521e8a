"""Stage `scene`: pictures, cameras, exact times and the box, in one place for everything that follows."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from devrf.capture.formats.scene_files import write_scene
from devrf.capture.scene import PosedFrame, Scene, image_scale_for
from devrf.capture.view_axes import behind
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.configured_dataset import configured_dataset
from devrf.pipelines.health.rows import HealthRow, listed, note, row
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.pictures import training

if TYPE_CHECKING:
    from devrf.calibration.bounds import Bounds

# per picture, where image_scale is not set
MAX_PIXELS = {"tiny": 64_000, "fast": 400_000, "reference": 10**9}
SURROUND = 0.5  # length of the mean view direction; below, cameras stand around the subject
MOST_BEHIND = 0.01  # of the sightings of points; structure from motion leaves fewer wrong ones
MOST_AWAY = 0.5  # of the cameras; turned axes turn them all
# Where voxels are larger a smaller box is sharper (2.5 and 2.6 pixels: held-out sweep + 0.2 and + 1.2 dB); where they
# are smaller, what it leaves outside gets coarser (1.47 pixels: - 1.7 dB).
PIXELS_A_VOXEL = 1.5
FEW_FRAMES = 5.0  # of a training camera, for a motion that is more than a guess


def run(context: StageContext) -> None:
    """Write `scene.json`, `static/transforms.json`, `dynamic/transforms.json` and `points.npz`."""
    config = context.config
    if config.dataset is not None:
        scene = _from_dataset(context)
    else:
        from devrf.pipelines.captured_scene import scene_from_capture  # a data set needs no vision library

        scene, bounds = scene_from_capture(context, lambda frames: widths_of_box(config, frames))
        context.health.extend(health(bounds, scene))
    trained = training(scene.frames) or scene.frames
    scene = replace(scene, image_scale=auto_image_scale(config, trained))
    in_motion = [frame for frame in scene.dynamic if frame.split == "train"]
    context.health.append(
        note(
            "pictures",
            f"{len(scene.static)} of the sweep, {len(in_motion)} in motion, scale {scene.image_scale:.3g}",
        )
    )
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
    context.health.extend(note("data set", text) for text in notes)
    context.health.extend(_views(scene))
    if scene.points is None:
        return scene
    from devrf.calibration.bounds import scene_bounds
    from devrf.pipelines.health.box import box_health

    start, end = scene.points.lines_of_sight(scene.static)
    bounds = scene_bounds(
        [f.camera for f in scene.static], [], scene.points.xyz, np.linalg.norm(end - start, axis=1)
    )
    context.health.extend(health(bounds, scene))
    context.health.extend(box_health(bounds, {}, None, scene.dynamic, scene.static))
    return replace(
        scene,
        box_from_world=bounds.box_from_world,
        aabb=bounds.aabb,
        near=bounds.near,
        far=bounds.far,
        kind=bounds.kind,
    )


def _views(scene: Scene) -> Iterator[HealthRow]:
    """Whether the cameras of a data set look at what they show: others write axes down in many ways.

    The axes of forward-facing sets run side by side and meet anywhere.
    """
    if scene.points is None and (scene.kind == "forward" or len(scene.static) < 2):
        return
    if scene.points is None:
        check, most = "cameras that look away from where their view axes meet", MOST_AWAY
    else:
        check, most = "sightings of sparse points behind their cameras", MOST_BEHIND
    yield row(
        check,
        100 * behind([frame.camera for frame in scene.static], scene.points),
        "%",
        warn_above=100 * most,
        remedy="The y and z axes of the poses seem to be turned round: OpenCV and COLMAP have y down and z "
        "forward, nerfstudio, Blender and LLFF y up and z backward; convert the poses.",
    )


@listed
def health(bounds: "Bounds", scene: Scene) -> Iterator[HealthRow]:
    """Rows about the box and about the time that is modelled."""
    unit = "m" if scene.metric else "units of arbitrary scale"
    size = " x ".join(f"{side:.3g}" for side in bounds.size)
    yield note("box", f"{size} {unit}, from {bounds.basis}")
    yield note("cameras", f"{bounds.kind} ({_spread(bounds)})")
    if bounds.points_outside is not None:
        yield note(
            "sweep's points outside the box",
            f"{100 * bounds.points_outside:.0f} % (they belong to the surroundings)",
        )
    if scene.dynamic:
        moving = {f.camera_name for f in scene.dynamic if f.split == "train"}
        counts = {name: sum(f.camera_name == name for f in scene.dynamic) for name in sorted(moving)}
        yield note("modelled time", f"{scene.t1_s - scene.t0_s:.3f} s, frames {counts}")
        few = ", ".join(f"{name} {count}" for name, count in counts.items() if count < FEW_FRAMES)
        yield row(
            "frames of the shortest training camera",
            float(min(counts.values(), default=0)),
            warn=FEW_FRAMES,
            fail=2.0,
            remedy=f"Hardly any frames lie in the modelled time ({few}): start these cameras before the action and "
            "stop them after it, or widen capture.range_s.",
        )
        if "hull" not in bounds.basis:
            yield note(
                "what moves",
                "not found in two cameras at once",
                remedy="The box is a guess from the view axes: check that something moves in all views.",
            )


def _spread(bounds: "Bounds") -> str:
    """The length of the mean view direction, and what it means where the word for it does not say all."""
    if bounds.kind == "inward" and bounds.mean_view > SURROUND:
        return f"{bounds.mean_view:.2f}, neither all around nor all one way: modelled as around the subject"
    return f"{bounds.mean_view:.2f}"
