"""The method as a list (DeVRF, Section 3): canonical, motion or movers, together, evaluation.

1. The sweep gives the scene at rest: voxels of density and features, a shallow MLP (3.1, 3.2).
2. The fixed cameras give its motion. What can be tracked is parts that move, trained together with what stands; else,
   and where these explain too little, motion is a 4D field, coarse to fine, with flow and cycle losses (3.1, 3.3).
3. With the field known, the scene at rest follows the pictures of all times.
4. The model is compared with pictures that it was never trained on (4).
"""

from collections.abc import Callable
from typing import Any

from devrf.capture.scene import Scene
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.evaluation.evaluate import evaluate
from devrf.reconstruct.evaluation.left_out_errors import errors_in_motion
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.training.fine_tune import fine_tune
from devrf.reconstruct.training.loop import ON_CPU, TrainingRun
from devrf.reconstruct.training.moving_parts import better_of, moving_parts, with_cost_of
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

canonical, evaluation = train_canonical, evaluate
MOTION = 0.9  # share of the progress bar, before fine-tuning

Moving = tuple[DynamicModel, dict[str, Any]]
"""The scene at rest with its motion, and what was measured."""


def motion(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    run: TrainingRun = ON_CPU,
    estimator: Callable[[], FlowEstimator] | None = None,
) -> Moving:
    """Motion by movers or by a field.

    Arguments and errors as `train_motion`'s, and `estimator`: makes one of optical flow where something is tracked;
    without it nothing is.
    """
    movers = None
    if options.together and estimator is not None:
        movers = moving_parts(scene, rest, options, run, estimator)
    if movers is None or isinstance(movers, Decision):
        model, metrics = motion_field(scene, rest, flows, options, run)
        return model, metrics | {"decisions": metrics["decisions"] + [str(m) for m in [movers] if m]}
    if movers.explain:
        return movers.model, movers.metrics
    model, metrics = motion_field(scene, rest, flows, options, run, leave_out=True)
    pictures = MovingPictures(scene.in_box_frame(), rest, run.device)
    return better_of(movers, model, metrics, errors_in_motion(pictures, model))


def motion_field(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    run: TrainingRun = ON_CPU,
    leave_out: bool = False,
) -> Moving:
    """Motion as a field, then the scene at rest as it looks in motion, if anything moves; as `train_motion`."""
    share = MOTION if options.fine_tuning else 1.0
    field, metrics = train_motion(scene, rest, flows, options, run.part("", 0.0, share), leave_out)
    if not options.fine_tuning or not metrics["iterations"]:
        return DynamicModel(rest, field), metrics
    tuned = fine_tune(scene, rest, field, options, run.part("fine-tuning", share, 1 - share))
    metrics = with_cost_of(metrics, tuned.metrics)
    metrics["decisions"] += [str(tuned.decision)] if tuned.decision is not None else []
    metrics |= {"fine_tuning_s": tuned.metrics["seconds"], "fine_tuning_gain_db": tuned.gain_db}
    return DynamicModel(rest, field, tuned.model), metrics
