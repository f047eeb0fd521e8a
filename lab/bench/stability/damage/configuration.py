"""Damage that is another configuration: cameras left out, learning rates, seeds."""

from dataclasses import replace

import numpy as np

from devrf.capture.scene import Scene
from devrf.lab.bench.stability.damage.intact import (
    Damage,
    DoesNotApply,
    Intact,
    behind_scene,
    with_capture,
)
from devrf.reconstruct.options import TrainingOptions

SEEDS_APART = 1000  # more than anyone repeats a case


def fewer_cameras(intact: Intact) -> Damage:
    """So many training cameras left out, those that stay spread over all."""
    count = len(intact.cameras) - int(intact.severity)
    if count < 1:
        raise DoesNotApply("cameras-too-few", f"there are {len(intact.cameras)} training cameras")
    last = len(intact.cameras) - 1
    keep = [intact.cameras[n] for n in np.linspace(0, last, count).round().astype(int)]
    capture = intact.capture
    if capture is not None:
        cameras = {n: c for n, c in capture.cameras.items() if n in keep or n in capture.test_names}
        return Damage(with_capture(intact.config, cameras=cameras))

    def without(scene: Scene) -> Scene:
        dynamic = tuple(f for f in scene.dynamic if f.split == "test" or f.camera_name in keep)
        return replace(scene, dynamic=dynamic)

    return behind_scene(intact, without)


def learning_rate(intact: Intact) -> Damage:
    """The learning rates of both trainings multiplied."""

    def faster(usual: TrainingOptions) -> TrainingOptions:
        rates = {"learning_rate": intact.severity}
        return TrainingOptions(replace(usual.canonical, **rates), replace(usual.motion, **rates))

    return Damage(intact.config, options=faster)


def other_seed(intact: Intact) -> Damage:
    """Nothing but another seed of the trainings."""
    seed = SEEDS_APART * int(intact.severity) + intact.seed
    reconstruct = intact.config.reconstruct.model_copy(update={"seed": seed})
    return Damage(intact.config.model_copy(update={"reconstruct": reconstruct}))
