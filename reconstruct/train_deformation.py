"""Stage 2 as a whole: how the scene moves, then the scene at rest as it looks in motion.

Where fixed cameras film what moves, it is tracked and split into rigid parts, which are trained together with what
stands; else, and where that explains too little, motion is a field (`train_motion.py`).
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from devrf.capture.errors import ReconstructError
from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import Scene
from devrf.flow.estimator import FlowEstimator
from devrf.flow.store import CameraFlow
from devrf.reconstruct.as_trained import as_trained
from devrf.reconstruct.checked_flow import CheckedFlow, checked_flow
from devrf.reconstruct.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.clocks import SHIFTS, picture_gap_s
from devrf.reconstruct.fine_tune import fine_tune
from devrf.reconstruct.late_camera import (
    FEWEST,
    WIDE,
    Moments,
    fits_better,
    moved_by,
    offset_pictures,
    suspect,
    without,
)
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.pictures import clips
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.sizing import Decision
from devrf.reconstruct.tracking.find import find_movers, trackable
from devrf.reconstruct.train_motion import train_motion
from devrf.reconstruct.train_movers import train_movers
from devrf.reconstruct.watch import Watch

TRACKING = 0.5  # share of the progress bar
LEAST_GAIN_DB = 1.0  # of movers over a scene in which nothing moves; with less, motion is a field
MOTION = 0.9  # share of the progress bar, before a late camera is looked for and fine-tuning


def train_deformation(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
    checkpoint: Checkpoint = NOWHERE,
    watch: Watch | None = None,
    reference: str | None = None,
    estimator: Callable[[], FlowEstimator] | None = None,
) -> tuple[DynamicModel, dict[str, Any]]:
    """The scene at rest with its motion, and what was measured.

    Arguments and errors as `train_motion`'s, and `reference`: the camera whose clock is everyone's; without one no late
    camera is looked for; `estimator`: makes one of optical flow where something is tracked; without it nothing is.
    """
    searched = reference if options.find_late_camera else None
    reason = None
    if options.together and estimator is not None and trackable(scene, rest):
        track = partial(
            _movers, rest=rest, options=options, device=device, progress=progress, estimator=estimator()
        )
        found = track(scene, checkpoint=checkpoint)
        if not isinstance(found, Decision):
            late = None if searched is None else _late_for(found[0], scene, rest, options, device, searched)
            return found if late is None else _with_late_movers(scene, track, checkpoint, found, late)
        reason = found
    model, metrics = _field(scene, rest, flows, options, device, progress, checkpoint, watch, searched)
    if reason is not None:
        metrics["decisions"].append(str(reason))
    return model, metrics


def _movers(
    scene: Scene,
    rest: RestModel,
    options: MotionOptions,
    device: str,
    progress: Progress,
    checkpoint: Checkpoint,
    estimator: FlowEstimator,
) -> tuple[DynamicModel, dict[str, Any]] | Decision:
    """The model with movers and what was measured, or why there is none: they explain too little."""
    start = time.monotonic()
    boxed = scene.in_box_frame()
    assert boxed.rest_time is not None  # trackable
    found = find_movers(
        boxed, rest, estimator, lambda f, m: progress(TRACKING * f, m), checkpoint.part("tracks")
    )
    if found is None:
        return Decision("movers", "none", "tracked", "too few points of the surface move")
    tracking_s = time.monotonic() - start
    parts = found.movers.parts
    try:
        trained = train_movers(
            boxed,
            rest,
            found.stands,
            found.movers,
            options,
            device,
            lambda f, m: progress(TRACKING + (1 - TRACKING) * f, m),
            checkpoint.part("movers"),
        )
    except ReconstructError as error:
        if error.code != "training-diverged":
            raise
        return Decision("movers", "none", f"{parts} rigid parts", str(error))
    gains = f"{trained.gain_db:+.2f} dB on pixels held back ({trained.unshaded_gain_db:+.2f} without shading)"
    if trained.unshaded_gain_db < LEAST_GAIN_DB:
        reason = f"{parts} rigid parts gained {gains}, expected {LEAST_GAIN_DB} without"
        return Decision("movers", "none", f"{parts} rigid parts", reason)
    keys = min(len(found.tracks.times), options.keys or options.most_keys)
    model = DynamicModel.of_movers(rest, trained.stands, trained.movers, keys, boxed.rest_time)
    assert model.motion is not None
    longest, part = found.longest_lost()
    middle = np.append(found.surface.xyz[found.labels == part].mean(0), 1.0)
    metrics = trained.metrics | {
        "keys": keys,
        "grid": list(model.motion.backward.shape[1:4]),
        "pictures": sum(len(clip) for clip in clips(scene).values()),
        "largest_motion": float(np.linalg.norm(found.tracks.xyz - found.surface.xyz, axis=-1).max()),
        "parts": parts,
        "points": len(found.surface),
        "lost_share": round(float(found.tracks.lost.mean()), 4),
        "longest_lost": longest,
        "longest_lost_at": (np.linalg.inv(scene.box_from_world) @ middle)[:3].round(3).tolist(),
        "movers_gain_db": round(trained.gain_db, 3),
        "movers_unshaded_gain_db": round(trained.unshaded_gain_db, 3),
        "tracking_s": round(tracking_s, 1),
        "decisions": [],
        "flow_contradicted": {},
    }
    metrics["seconds"] += tracking_s
    return model, metrics


def _late_for(
    model: DynamicModel, scene: Scene, rest: RestModel, options: MotionOptions, device: str, reference: str
) -> tuple[str, float] | None:
    """A camera whose pictures fit the motion clearly better at other times, and by how many pictures; or None."""
    names = tuple(clips(scene))
    if len(names) < FEWEST:
        return None
    moments = Moments(scene, rest, options, device)
    name = suspect({name: moments.curves(model, name, SHIFTS) for name in names}, reference)
    pictures = 0.0 if name is None else offset_pictures(moments.curves(model, name, WIDE), WIDE)
    return None if name is None or pictures == 0 else (name, pictures)


def _with_late_movers(
    scene: Scene,
    track: Callable[..., tuple[DynamicModel, dict[str, Any]] | Decision],
    checkpoint: Checkpoint,
    before: tuple[DynamicModel, dict[str, Any]],
    late: tuple[str, float],
) -> tuple[DynamicModel, dict[str, Any]]:
    """Movers with the clock of one camera moved, if these explain pixels held back better; else as before."""
    name, pictures = late
    offset_s = pictures * picture_gap_s(clips(scene)[name])
    again = track(moved_by(scene, name, offset_s), checkpoint=checkpoint.part("late"))
    if isinstance(again, Decision):
        return before
    (model, metrics), (other, measured) = before, again
    if measured["movers_gain_db"] <= metrics["movers_gain_db"]:
        return model, _with_cost_of(metrics, measured)
    found = {"name": name, "pictures": pictures, "offset_s": offset_s}
    return other, _with_cost_of(measured, metrics) | {"late_camera": found}


def _field(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str,
    progress: Progress,
    checkpoint: Checkpoint,
    watch: Watch | None,
    searched: str | None,
) -> tuple[DynamicModel, dict[str, Any]]:
    """Motion as a field, then the scene at rest as it looks in motion; `searched`: whose clock is everyone's."""
    share, check = MOTION if options.fine_tuning or searched is not None else 1.0, _CheckedOnce()
    motion, metrics = train_motion(
        scene,
        rest,
        flows,
        options,
        device,
        lambda f, m: progress(share * f, m),
        checkpoint,
        watch,
        check,
    )
    if searched is not None:
        motion, metrics = _with_late_camera(
            scene, rest, flows, options, device, progress, checkpoint, searched, check, motion, metrics
        )
    if not options.fine_tuning:
        return DynamicModel(rest, motion), metrics
    tuned = fine_tune(
        as_trained(scene, metrics),
        rest,
        motion,
        options,
        device,
        lambda f, m: progress(share + (1 - share) * f, m),
        checkpoint.part("fine-tuning"),
    )
    metrics = _with_cost_of(metrics, tuned.metrics)
    metrics["decisions"] += [str(tuned.decision)] if tuned.decision is not None else []
    metrics |= {"fine_tuning_s": tuned.metrics["seconds"], "fine_tuning_gain_db": tuned.gain_db}
    return DynamicModel(rest, motion, tuned.model), metrics


def _with_late_camera(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str,
    progress: Progress,
    checkpoint: Checkpoint,
    reference: str,
    check: "_CheckedOnce",
    motion: MotionField,
    metrics: dict[str, Any],
) -> tuple[MotionField, dict[str, Any]]:
    """The same with the clock of one camera moved, if the motion that the others see says so."""
    names = tuple(clips(scene))
    if len(names) < FEWEST:
        return motion, metrics
    moments = Moments(scene, rest, options, device)
    curves = {name: moments.curves(DynamicModel(rest, motion), name, SHIFTS) for name in names}
    name = suspect(curves, reference)
    if name is None:
        return motion, metrics
    before = {camera: errors[:, SHIFTS == 0] for camera, errors in curves.items()}
    del moments  # its pictures, while others are trained on
    coarse = replace(options, levels=options.levels[:1], iterations=options.iterations[:1])
    others, cost = train_motion(
        without(scene, name),
        rest,
        flows,
        coarse,
        device,
        lambda f, m: progress(MOTION, f"without {name}: {m}"),
        checkpoint.part(f"without{names.index(name)}"),
        check=check,
    )
    metrics = _with_cost_of(metrics, cost)
    pictures = offset_pictures(
        Moments(scene, rest, options, device).curves(DynamicModel(rest, others), name, WIDE), WIDE
    )
    del others
    if pictures == 0:
        return motion, metrics
    offset_s = pictures * picture_gap_s(clips(scene)[name])
    again, new = train_motion(
        moved_by(scene, name, offset_s),
        rest,
        flows,
        options,
        device,
        lambda f, m: progress(MOTION, f"{name} moved: {m}"),
        checkpoint.part(f"moved{names.index(name)}_{pictures:+.2f}"),
        check=check,
    )
    moments = Moments(scene, rest, options, device)
    shift = {camera: np.array([pictures if camera == name else 0.0]) for camera in names}
    after = {camera: moments.curves(DynamicModel(rest, again), camera, shift[camera]) for camera in names}
    if not fits_better(before, after):
        return motion, _with_cost_of(metrics, new)
    found = {"name": name, "pictures": pictures, "offset_s": offset_s}
    return again, _with_cost_of(new, metrics) | {"late_camera": found}


class _CheckedOnce:
    """Flow held against the pictures when it is first asked for."""

    def __init__(self) -> None:
        self.found: CheckedFlow | None = None

    def __call__(self, rays: RaySet, flows: Mapping[str, CameraFlow]) -> CheckedFlow:
        """What was found of all cameras; the motion's later trainings have some of the same pictures."""
        self.found = self.found or checked_flow(rays, flows)
        return self.found


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
