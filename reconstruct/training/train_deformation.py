"""Stage 2 as a whole: how the scene moves, then the scene at rest as it looks in motion.

Where fixed cameras film what moves, it is tracked and split into rigid parts, or soft ones where that explains more,
which are trained together with what stands; else, and where that explains too little, motion is a field
(`train_motion.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.evaluation.left_out_errors import Errors, errors_in_motion
from devrf.reconstruct.evaluation.paired import gain_text
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.sampling.pictures import clips
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.tracking.find import Found, find_movers, why_not_tracked
from devrf.reconstruct.training.fine_tune import fine_tune
from devrf.reconstruct.training.own_motion import fit_own
from devrf.reconstruct.training.train_motion import train_motion
from devrf.reconstruct.training.train_movers import train_movers, untrained_errors

DIVERGED = "training-diverged"  # code of the error
TRACKING = 0.5  # share of the progress bar
# Of movers over a scene in which nothing moves, on pixels left out of training: with less, a field is trained, too. It
# says whether a second training is worth its time, not which of both is taken.
DOUBTED_DB = 3.0
RIGID, SOFT = "rigid", "soft"
TRACKED = "on pixels that tracking has read"
LEFT_OUT = "on pixels left out of training (tracking and flow have read them)"
MOTION = 0.9  # share of the progress bar, before fine-tuning


def train_deformation(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
    checkpoint: Checkpoint = NOWHERE,
    watch: Watch | None = None,
    estimator: Callable[[], FlowEstimator] | None = None,
    own: str = "auto",
) -> tuple[DynamicModel, dict[str, Any]]:
    """The scene at rest with its motion, and what was measured.

    Arguments and errors as `train_motion`'s, and `estimator`: makes one of optical flow where something is tracked;
    without it nothing is. `own`: a motion model of an installed package, in place of all others.
    """
    if own != "auto":
        return fit_own(own, scene, rest, flows, options, progress)
    tracked = None
    if options.together and estimator is not None:
        tracked = _movers(scene, rest, options, device, progress, checkpoint, estimator)
        if not isinstance(tracked, Decision) and tracked.metrics["movers_unshaded_gain_db"] >= DOUBTED_DB:
            return tracked.model, tracked.metrics
    competes = isinstance(tracked, _Tracked)
    model, metrics = _field(scene, rest, flows, options, device, progress, checkpoint, watch, competes)
    if tracked is None:
        return model, metrics
    if isinstance(tracked, Decision):
        metrics["decisions"].append(str(tracked))
        return model, metrics
    pictures = MovingPictures(scene.in_box_frame(), rest, device)
    return _of_both(tracked, model, metrics, errors_in_motion(pictures, model))


@dataclass(frozen=True)
class _Tracked:
    """A model with movers.

    Attributes:
        model, metrics: What came of it, and what was measured.
        errors: Of pixels left out of training, without shading.
    """

    model: DynamicModel
    metrics: dict[str, Any]
    errors: Errors


def _of_both(
    movers: _Tracked, model: DynamicModel, metrics: dict[str, Any], field_errors: Errors
) -> tuple[DynamicModel, dict[str, Any]]:
    """The field where it explains more than the movers, by more than chance, or where these explain nothing."""
    parts, gain = f"{movers.metrics['parts']} parts", field_errors.gain_over(movers.errors)
    reason = f"{LEFT_OUT} a field gains {gain_text(gain)} over {parts} without shading"
    gain_db = movers.metrics["movers_unshaded_gain_db"]
    reason += f"; these gain {gain_db:+.2f} dB over a scene in which nothing moves"
    if gain.side() > 0 or gain_db <= 0:
        other, decision = movers.metrics, Decision("movers", "none", parts, reason)
    else:
        model, metrics, other = movers.model, movers.metrics, metrics
        decision = Decision("movers", parts, "a field", reason)
    metrics = _with_cost_of(metrics, other)
    return model, metrics | {"decisions": [*metrics["decisions"], str(decision)]}


def _movers(
    scene: Scene,
    rest: RestModel,
    options: MotionOptions,
    device: str,
    progress: Progress,
    checkpoint: Checkpoint,
    estimator: Callable[[], FlowEstimator],
) -> _Tracked | Decision:
    """The model with movers and what was measured, or why there is none: tracking cannot be, or explains too little."""
    why = why_not_tracked(scene, rest)
    if why is not None:
        return Decision("movers", "none", "tracked", why)
    log = TrainingLog("cpu", 1)
    boxed = scene.in_box_frame()
    assert boxed.rest_time is not None  # it can be tracked
    found, decisions = find_movers(
        boxed, rest, estimator(), part(progress, 0.0, TRACKING), checkpoint.part("tracks"), log
    )
    if found is None:
        return Decision("movers", "none", "tracked", "too few points of the surface move")
    pictures = MovingPictures(boxed, rest, device)
    found, softness = _softened(boxed, rest, found, options, pictures)
    tracking_s = log.seconds
    try:
        trained = train_movers(
            boxed,
            rest,
            found.stands,
            found.movers,
            options,
            device,
            part(progress, TRACKING, 1 - TRACKING),
            checkpoint.part("movers"),
            found.offsets_s,
            pictures,
        )
    except ReconstructError as error:
        if error.code != DIVERGED:
            raise
        return Decision("movers", "none", f"{found.movers.parts} parts", str(error))
    parts = found.movers.parts
    keys = min(len(found.tracks.times), options.keys or options.most_keys)
    model = DynamicModel.of_movers(rest, trained.stands, trained.movers, keys, boxed.rest_time)
    assert model.motion is not None
    metrics = trained.metrics | {
        "keys": keys,
        "grid": list(model.motion.backward.shape[1:4]),
        "pictures": sum(len(clip) for clip in clips(scene).values()),
        "largest_motion": float(np.linalg.norm(found.tracks.xyz - found.surface.xyz, axis=-1).max()),
        "parts": parts,
        "points": len(found.surface),
        "lost_share": round(float(found.tracks.lost.mean()), 4),
        "rigid_parts": found.told(scene.box_from_world),
        "movers_gain_db": round(trained.errors.gain_db(trained.errors_at_rest), 3),
        "movers_unshaded_gain_db": round(trained.unshaded_errors.gain_db(trained.errors_at_rest), 3),
        "tracking_s": round(tracking_s, 1),
        "clock_offsets_s": found.offsets_s,
        "decisions": [*map(str, decisions), str(softness)],
        "flow_contradicted": {},
    }
    metrics["seconds"] += tracking_s
    return _Tracked(model, metrics, trained.unshaded_errors)


def _softened(
    boxed: Scene, rest: RestModel, found: Found, options: MotionOptions, pictures: MovingPictures
) -> tuple[Found, Decision]:
    """What was found, with parts that may stretch where that explains more before training, by more than chance."""
    soft = found.softened()
    motions = [found.movers, soft.movers]
    by_rigid, by_soft = untrained_errors(boxed, rest, found.stands, motions, options, pictures)
    gain = by_soft.gain_over(by_rigid)
    reason = f"{TRACKED} soft ones gain {gain_text(gain)} before training"
    chosen, other = (SOFT, RIGID) if gain.side() > 0 else (RIGID, SOFT)
    return (soft if chosen == SOFT else found), Decision("parts", chosen, other, reason)


def _field(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str,
    progress: Progress,
    checkpoint: Checkpoint,
    watch: Watch | None,
    competes: bool,
) -> tuple[DynamicModel, dict[str, Any]]:
    """Motion as a field, then the scene at rest as it looks in motion, if anything moves.

    Where it competes with movers, the pixels by which both are judged are left out.
    """
    share = MOTION if options.fine_tuning else 1.0
    motion, metrics = train_motion(
        scene,
        rest,
        flows,
        options,
        device,
        lambda f, m: progress(share * f, m),
        checkpoint,
        watch,
        competes,
    )
    if not options.fine_tuning or not metrics["iterations"]:
        return DynamicModel(rest, motion), metrics
    tuned = fine_tune(
        scene,
        rest,
        motion,
        options,
        device,
        part(progress, share, 1 - share),
        checkpoint.part("fine-tuning"),
    )
    metrics = _with_cost_of(metrics, tuned.metrics)
    metrics["decisions"] += [str(tuned.decision)] if tuned.decision is not None else []
    metrics |= {"fine_tuning_s": tuned.metrics["seconds"], "fine_tuning_gain_db": tuned.gain_db}
    return DynamicModel(rest, motion, tuned.model), metrics


def _with_cost_of(metrics: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """What a training measured, and what another one took of time, memory and smaller steps."""
    out = dict(metrics)
    for name in ("seconds", "iterations", "rays", "restarts"):
        out[name] += other[name]
    for name in ("peak_rss_gb", "peak_gpu_gb"):
        out[name] = max(out[name], other[name]) if out[name] is not None else None
    out["rate"] = min(out["rate"], other["rate"])
    out["rays_per_s"] = round(out["rays"] / max(out["seconds"], 1e-9))
    return out
