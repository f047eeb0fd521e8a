"""Stage 2 with a motion model of an installed package, in place of tracked parts and of the field that is trained here.

A package of your own adds one by an entry point of the group `devrf.motion`: its name is the model's, and it leads to
a function of `(device: str)` that gives a `MotionModel`.
"""

from typing import Any, Protocol

import torch

from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError, ReconstructError
from devrf.capture.system.progress import Progress
from devrf.flow.methods import installed
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.key_times import offered_keys, rest_key_of
from devrf.reconstruct.adapt.motion_box import motion_box
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.options import OWN_MOTION, MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.storage.training_log import TrainingLog


class MotionModel(Protocol):
    """Finds how a scene moves, by the pictures that may be trained on (`split` is `train`)."""

    def fit(
        self,
        scene: Scene,
        rest: RestModel,
        flows: dict[str, CameraFlow],
        motion: MotionField,
        progress: Progress,
    ) -> MotionField:
        """The motion.

        Args:
            scene: In the box frame.
            rest: The scene at rest, trained; stays as it is.
            flows: Backward optical flow by camera.
            motion: Still, with box, key times and vertices for the scene: to be filled, or replaced.
            progress: To be called with (fraction done, short text).
        """
        ...


def fit_own(
    name: str,
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    progress: Progress,
) -> tuple[DynamicModel, dict[str, Any]]:
    """The scene at rest with the field that the motion model called `name` finds, and what was measured.

    Raises:
        InputError: The model cannot be made.
        ReconstructError: No training pictures of the scene in motion; the model gave no field, or none of numbers.
    """
    point, device = installed(OWN_MOTION)[name], str(rest.canonical.density.device)
    try:
        own: MotionModel = point.load()(device)
    except Exception as error:  # somebody else's code: whatever it raises, the user is told whose it is
        text = f"reconstruct.motion: {name}: {point.value} cannot be used ({type(error).__name__}: {error})"
        raise InputError("method-unusable", text) from error
    scene, log = scene.in_box_frame(), TrainingLog(device, 1)
    frames = training(scene.dynamic)
    times = sorted({f.time for f in frames if f.time is not None})
    if not times:
        raise ReconstructError("pictures-none", "no training pictures of the scene in motion")
    keys, box = offered_keys(frames, options), motion_box(scene, rest, frames, len(times))
    at_rest = None if scene.rest_time is None else rest_key_of(scene.rest_time, times, keys)
    still = MotionField.still(box, keys, options.levels[-1], (times[0], times[-1]), at_rest, device)
    motion = own.fit(scene, rest, flows, still, progress)
    shapes, sums = motion.backward.shape == motion.forward.shape, motion.backward.sum() + motion.forward.sum()
    if not (shapes and torch.isfinite(sums)):
        wrong = (
            f"reconstruct.motion: {name}: backward and forward are to be finite, of one shape [T, X, Y, Z, 3]"
        )
        raise ReconstructError("estimator-result-wrong", f"{wrong}; mend {point.value}")
    metrics = log.summary() | {"restarts": 0, "rate": 1.0, "flow_contradicted": {}}
    metrics |= {"keys": motion.keys, "grid": list(motion.backward.shape[1:4]), "pictures": len(frames)}
    metrics["largest_motion"] = float(motion.forward.norm(dim=-1).max())
    metrics["decisions"] = [f"motion: by {name} ({point.value})"]
    return DynamicModel(rest, motion.stored(device)), metrics
