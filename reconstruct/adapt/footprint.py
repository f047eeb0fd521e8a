"""How much memory a training will take at its peak, from the shapes of what it holds.

Each part is a number of bytes per vertex, pixel, ray or sample. Those of grids follow from what training keeps: values,
gradient and two moments of 4 bytes each, and how far a vertex is from anything and whether steps visit it; what an
occupancy rebuild needs for a moment and what samples leave until the backward pass was measured (docs/reliability.md).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.adapt.sizing import fewer_voxels
from devrf.reconstruct.fields.grids import FEW
from devrf.reconstruct.fields.motion import MOST_ON_GPU
from devrf.reconstruct.fields.ndc import CUBE, Ndc
from devrf.reconstruct.options import STEP_AT_REST, CanonicalOptions, MotionOptions
from devrf.reconstruct.sampling.clean_plate import MOST_BYTES
from devrf.reconstruct.sampling.pictures import training

# Measured on a CPU as differences of peaks between trainings that differ in one size (Linux, torch 2.13, warp 1.17).
IMPORTED = 310e6  # of libraries, when all is imported
AT_WORK = 160e6  # more of them after the first iterations
TRAINED = 16  # per value: itself, gradient, two moments
GOOD = 4  # per value: as it was at the last good point
VERTEX, VERTEX_STAYS = 37, 9  # per vertex beside: while occupancy is rebuilt, and else
# of the surroundings: four values, two gradients, and positions as it grows
SHELL_VERTEX, SHELL_VERTEX_STAYS = 120, 89
SHELL_VALUES = 4  # density and colour
SHELL_SAMPLE = 20  # distance, raw density and colour, until the backward pass
# Of a ray, per vertex of a side: memory of the CPU that no sample is written to is never touched (measured); on a GPU
# both tables, before the box and behind it, are there whole (kernels/background.py: most_samples, at the largest reach)
SHELL_SAMPLES, SHELL_SAMPLES_ON_GPU = 2.5, 7.5
COARSE_VERTEX = 145  # of the first model of everything: its share of opaque space is handed on beside
SAMPLE = 440  # per sample in the box, until the backward pass
SAMPLE_PER_UNIT = 15  # and per hidden unit, where the MLP is asked per sample
MOVING_SAMPLE = 750  # with its way to rest and back
PIXEL = 3
MATTE = 1  # per pixel of pictures before a plain background
LENS_PIXEL = 36  # of a lens: a viewing direction; the rest while lens distortion is undone
VIEW_PIXEL = 28  # of a camera that stands still: what is outside the box; twice that while it is put together
# vectors, confidence, agreement as they are read and checked; in training's order
FLOW_PIXEL_READ, FLOW_PIXEL = 8, 6

CHANNELS = 13  # density and features
REST_VERTEX = 4 * CHANNELS + 1  # of a scene at rest that is looked at
AROUND = 5 * (4 * 4 + 1)  # and of its surroundings, which have (192 / 112)^3 = 5 vertices for each of its own
FIELD_VERTEX = 2 * 3 * 4  # of both motion fields, per key time
READ = 2  # times a scene at rest, while it is unpacked

TRACKED, TRACKED_CAMERA = 150e6, 30e6  # of OpenCV and points; of the pictures of a camera that are remembered
MLP_WIDTH = 64  # of the presets that track

SAMPLES_PER_RAY = 16  # in motion; of solid things fewer count, of things still translucent these (measured)
SAMPLES_PER_RAY_AT_REST = 40  # in fine-tuning, whose steps are half as long
KEYS_IN_WINDOW = 5  # of a field too large for a GPU: around a key all that its pictures touch

Parts = dict[str, int | float]
"""Bytes by what they are for."""


@dataclass(frozen=True)
class Footprint:
    """Peak memory of one training by part, bytes: main memory and that of the GPU."""

    main: dict[str, int]
    gpu: dict[str, int]

    @property
    def main_bytes(self) -> int:
        """Of main memory."""
        return sum(self.main.values())


@dataclass(frozen=True)
class SceneSize:
    """How much there is to train on, at training size.

    Attributes:
        still_pixels, moving_pixels: Of all training pictures of the sweep, and of the moving cameras.
        still_lenses, moving_lenses: Pixels of one picture of each distinct lens.
        views: Pixels of one picture of each moving camera; of each picture, where cameras do not stand still.
        largest_clip: Pixels of the camera with most of them.
        times: Pictures of the camera with most of them.
        cameras: That move, or film what moves.
        plain: The subject is before a plain background; else surroundings are modelled.
    """

    still_pixels: int
    moving_pixels: int = 0
    still_lenses: int = 0
    moving_lenses: int = 0
    views: int = 0
    largest_clip: int = 0
    times: int = 0
    cameras: int = 0
    plain: bool = True

    @staticmethod
    def of(scene: Scene) -> "SceneSize":
        """Of a scene."""

        def pixels(frames: Sequence[PosedFrame], key: Any = None) -> int:
            """Of all pictures, or of one of each with the same key."""
            one_of = list({key(f): f for f in frames}.values()) if key is not None else frames
            sizes = [f.camera.scaled(scene.image_scale) for f in one_of]
            return sum(camera.width * camera.height for camera in sizes)

        def lens(frame: PosedFrame) -> Any:
            return frame.camera.lens

        def view(frame: PosedFrame) -> Any:
            return frame.camera.view

        still = training(scene.static)
        moving = training(scene.dynamic)
        clips = [[f for f in moving if f.camera_name == name] for name in {f.camera_name for f in moving}]
        return SceneSize(
            still_pixels=pixels(still),
            moving_pixels=pixels(moving),
            still_lenses=pixels(still, lens),
            moving_lenses=pixels(moving, lens),
            views=pixels(moving, view),
            largest_clip=max(map(pixels, clips), default=0),
            times=max(map(len, clips), default=0),
            cameras=len(clips),
            plain=scene.background != "shell",
        )


def footprint(
    scene: Scene | SceneSize, options: CanonicalOptions | MotionOptions, device: str = "cpu", held: int = 0
) -> Footprint:
    """Predicted peak of a training.

    Args:
        scene: What is trained on; of a `Scene` also what `adapt` takes off the resolution at rest is known.
        options: Of the scene at rest, or of the motion (its `resolution` is that of the scene at rest).
        device: cpu or cuda.
        held: Bytes of main memory that the process holds before, everything imported.
    """
    return footprints(scene, device, held)(options)


def footprints(
    scene: Scene | SceneSize, device: str = "cpu", held: int = 0
) -> Callable[[CanonicalOptions | MotionOptions], Footprint]:
    """The same of any options, for a scene that is looked at once."""
    size = SceneSize.of(scene) if isinstance(scene, Scene) else scene
    adapted = _adapting(scene) if isinstance(scene, Scene) else lambda options: options

    def of(options: CanonicalOptions | MotionOptions) -> Footprint:
        libraries = max(IMPORTED, held) + AT_WORK
        if isinstance(options, CanonicalOptions):
            kept, trained = {}, _at_rest(size, adapted(options), on_gpu=device != "cpu")
        else:
            kept, trained = _in_motion(size, options, on_gpu=device != "cpu")
        main = {"libraries": libraries} | kept
        if device == "cpu":
            return Footprint(_whole(main | trained), {})
        # read here, and written as a checkpoint
        brought = {name: trained.get(name, 0) for name in ("pictures", "models", "checkpoint")}
        return Footprint(_whole(main | brought), _whole(trained))

    return of


def _at_rest(size: SceneSize, o: CanonicalOptions, on_gpu: bool) -> Parts:
    """What is trained, or trained on."""
    box, around = o.resolution**3, 0 if size.plain else o.shell_resolution**3
    trained, shell_good = (TRAINED + GOOD) * (1 + o.channels), GOOD * SHELL_VALUES
    models = box * (trained + VERTEX) + around * (SHELL_VERTEX + shell_good)
    first = 0.0
    if not size.plain or o.box_search == "coarse":
        first = o.coarse_size**3 * COARSE_VERTEX + models / 2 ** len(o.scale_at)
    per_sample = SAMPLE + (0 if o.deferred else SAMPLE_PER_UNIT * o.mlp_width)
    of_ray = SHELL_SAMPLES_ON_GPU if on_gpu else SHELL_SAMPLES
    per_ray = 0.0 if size.plain else SHELL_SAMPLE * of_ray * o.shell_resolution
    common: Parts = {"pictures": _picture_bytes(size, size.still_pixels, size.still_lenses)}
    beginning = common | {"plates": min(MOST_BYTES, PIXEL * size.largest_clip) * (not size.plain)}
    if not size.plain:  # of fixed cameras, each with a lens of its own
        common["plates"] = (
            _picture_bytes(size, size.moving_lenses, size.moving_lenses) + 4 * size.moving_lenses
        )
    training = common | {
        "models": max(first, models),
        "samples": (o.samples * per_sample + o.rays * (_steps_bytes(o, STEP_AT_REST) + per_ray)) / o.parts,
    }
    writing = common | {
        "models": box * (trained + VERTEX_STAYS) + around * (SHELL_VERTEX_STAYS + shell_good),
        "checkpoint": box * _checkpoint_bytes(1, o.channels) + around * _checkpoint_bytes(SHELL_VALUES),
    }
    return _largest([beginning, training, writing])


def _in_motion(size: SceneSize, o: MotionOptions, on_gpu: bool) -> tuple[Parts, Parts]:
    """What stays in main memory in any case, and what is trained, or trained on."""
    vertices, finest = o.resolution**3, o.levels[-1] ** 3
    before = o.levels[-2] ** 3 if len(o.levels) > 1 else 0  # a field that is refined is there twice
    keys = max(2, min(o.keys or o.most_keys, size.times))
    apart = on_gpu and FIELD_VERTEX * keys * finest > MOST_ON_GPU
    fields = FIELD_VERTEX * keys * (finest + before)
    on_device = FIELD_VERTEX * min(keys, KEYS_IN_WINDOW) * finest if apart else fields
    rest = vertices * (REST_VERTEX + AROUND * (not size.plain))
    common = {
        "pictures": _picture_bytes(size, size.moving_pixels, size.moving_lenses) + PIXEL * size.largest_clip,
        "surroundings": VIEW_PIXEL * size.views,
    }
    reading = {"models": READ * rest}
    beginning = common | {"surroundings": 2 * VIEW_PIXEL * size.views, "models": rest}
    moving = o.rays * SAMPLES_PER_RAY * MOVING_SAMPLE
    motion = common | {
        "flow": FLOW_PIXEL * size.moving_pixels * (o.flow > 0),
        "models": rest
        + on_device
        + 8 * 12 * finest,  # gradient, moments and beginning of one key of both fields
        "samples": moving + o.rays * _steps_bytes(o, o.stepsize),
    }
    tuning = common | {
        "sweep": _picture_bytes(size, size.still_pixels, size.still_lenses),
        "models": rest + on_device + vertices * (TRAINED * CHANNELS + VERTEX),
        "samples": moving + o.rays * (SAMPLES_PER_RAY_AT_REST * SAMPLE + _steps_bytes(o, o.stepsize)),
    }
    writing = tuning | {
        "models": rest + on_device + vertices * (TRAINED * CHANNELS + VERTEX_STAYS),
        "samples": 0,
        "checkpoint": vertices * _checkpoint_bytes(1, CHANNELS - 1),
    }
    per_sample = SAMPLE + SAMPLE_PER_UNIT * MLP_WIDTH
    # Both layers as they were found, with gradient and moments, and as trained before with other clocks.
    movers = common | {
        "tracking": TRACKED + TRACKED_CAMERA * size.cameras,
        "sweep": _picture_bytes(size, size.still_pixels, size.still_lenses),
        "models": rest + 2 * vertices * ((TRAINED + 4 + 4) * CHANNELS + VERTEX),
        "samples": o.together_rays * (SAMPLES_PER_RAY_AT_REST * per_sample + _steps_bytes(o, o.stepsize)),
    }
    phases = [reading, beginning, motion, *([tuning, writing] if o.fine_tuning else [])]
    phases += [movers] if o.together and not size.plain else []
    kept: Parts = {
        "flow as read": FLOW_PIXEL_READ * size.moving_pixels * (o.flow > 0),
        "motion field": fields * apart,
    }
    return kept, _largest(phases)


def _picture_bytes(size: SceneSize, pixels: int, lenses: int) -> int:
    return pixels * (PIXEL + MATTE * size.plain) + LENS_PIXEL * lenses


def _steps_bytes(o: CanonicalOptions | MotionOptions, stepsize: float) -> float:
    """Per ray, of the table of steps through the box."""
    return 4 * math.sqrt(3) * o.resolution / stepsize


def _checkpoint_bytes(*channels: int) -> float:
    """Per vertex, of both moments as a checkpoint holds them: copies, and numbers of their vertices."""
    return sum(2 * FEW * (8 + 4 * count) for count in channels)


def _largest(phases: list[Parts]) -> Parts:
    return max(phases, key=lambda parts: sum(parts.values()))


def _adapting(scene: Scene) -> Callable[[CanonicalOptions], CanonicalOptions]:
    """No more voxels than pictures show; the box found later may be smaller than the scene's, not larger."""
    boxed = scene.in_box_frame()
    cameras = [f.camera.scaled(scene.image_scale) for f in training(boxed.static)]
    ndc = None if scene.ndc is None else Ndc(*scene.ndc)
    aabb = CUBE if ndc is not None else torch.tensor(boxed.aabb, dtype=torch.float32)

    def adapted(options: CanonicalOptions) -> CanonicalOptions:
        return fewer_voxels(options, cameras, aabb, ndc)[0] if options.adapt and cameras else options

    return adapted


def _whole(parts: Parts) -> dict[str, int]:
    return {name: round(value) for name, value in parts.items() if value}
