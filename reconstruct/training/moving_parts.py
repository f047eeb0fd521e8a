"""Motion as parts that are tracked: rigid ones, or soft where that explains more, trained together with what stands."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.flow.estimator import FlowEstimator
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.evaluation.left_out_errors import Errors
from devrf.reconstruct.evaluation.paired import gain_text
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.sampling.pictures import clips
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.tracking.find import TrackedParts, find_movers, why_not_tracked
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_movers import train_movers, untrained_errors

DIVERGED = "training-diverged"  # code of the error
TRACKING = 0.5  # share of the progress bar
# Of movers over a scene in which nothing moves, on pixels left out of training: with less, a field is trained, too. It
# says whether a second training is worth its time, not which of both is taken.
DOUBTED_DB = 3.0
RIGID, SOFT = "rigid", "soft"
TRACKED = "on pixels that tracking has read"
LEFT_OUT = "on pixels left out of training (tracking and flow have read them)"


@dataclass(frozen=True)
class MovingParts:
    """A model with movers.

    Attributes:
        model, metrics: What came of it, and what was measured.
        errors: Of pixels left out of training, without shading.
    """

    model: DynamicModel
    metrics: dict[str, Any]
    errors: Errors

    @property
    def explain(self) -> bool:
        """Whether they explain so much of what moves that a field need not be tried."""
        return self.metrics["movers_unshaded_gain_db"] >= DOUBTED_DB


def moving_parts(
    scene: Scene,
    rest: RestModel,
    options: MotionOptions,
    run: TrainingRun,
    estimator: Callable[[], FlowEstimator],
) -> MovingParts | Decision:
    """The model with movers and what was measured, or why there is none: tracking cannot be, or explains too little."""
    why = why_not_tracked(scene, rest)
    if why is not None:
        return Decision("movers", "none", "tracked", why)
    log = TrainingLog("cpu", 1)
    boxed = scene.in_box_frame()
    assert boxed.rest_time is not None  # it can be tracked
    tracking = run.part("tracks", 0.0, TRACKING)
    found, decisions = find_movers(boxed, rest, estimator(), tracking.progress, tracking.checkpoint, log)
    if found is None:
        return Decision("movers", "none", "tracked", "too few points of the surface move")
    pictures = MovingPictures(boxed, rest, run.device)
    found, softness = _softened(pictures, found, options)
    tracking_s = log.seconds
    try:
        together = run.part("movers", TRACKING, 1 - TRACKING)
        trained = train_movers(pictures, found.stands, found.movers, options, together, found.offsets_s)
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
    return MovingParts(model, metrics, trained.unshaded_errors)


def better_of(
    movers: MovingParts, model: DynamicModel, metrics: dict[str, Any], errors: Errors
) -> tuple[DynamicModel, dict[str, Any]]:
    """The field where it explains more than the movers, by more than chance, or where these explain nothing."""
    gain = errors.gain_over(movers.errors)
    parts = f"{movers.metrics['parts']} parts"
    reason = f"{LEFT_OUT} a field gains {gain_text(gain)} over {parts} without shading"
    gain_db = movers.metrics["movers_unshaded_gain_db"]
    reason += f"; these gain {gain_db:+.2f} dB over a scene in which nothing moves"
    if gain.side() > 0 or gain_db <= 0:
        other, decision = movers.metrics, Decision("movers", "none", parts, reason)
    else:
        model, metrics, other = movers.model, movers.metrics, metrics
        decision = Decision("movers", parts, "a field", reason)
    metrics = with_cost_of(metrics, other)
    return model, metrics | {"decisions": [*metrics["decisions"], str(decision)]}


def _softened(
    pictures: MovingPictures, found: TrackedParts, options: MotionOptions
) -> tuple[TrackedParts, Decision]:
    """What was found, with parts that may stretch where that explains more before training, by more than chance."""
    soft = found.softened()
    motions = [found.movers, soft.movers]
    by_rigid, by_soft = untrained_errors(pictures, found.stands, motions, options)
    gain = by_soft.gain_over(by_rigid)
    reason = f"{TRACKED} soft ones gain {gain_text(gain)} before training"
    chosen, other = (SOFT, RIGID) if gain.side() > 0 else (RIGID, SOFT)
    return (soft if chosen == SOFT else found), Decision("parts", chosen, other, reason)


def with_cost_of(metrics: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """What a training measured, and what another one took of time, memory and smaller steps."""
    out = dict(metrics)
    for name in ("seconds", "iterations", "rays", "restarts"):
        out[name] += other[name]
    for name in ("peak_rss_gb", "peak_gpu_gb"):
        out[name] = max(out[name], other[name]) if out[name] is not None else None
    out["rate"] = min(out["rate"], other["rate"])
    out["rays_per_s"] = round(out["rays"] / max(out["seconds"], 1e-9))
    return out
