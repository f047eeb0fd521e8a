"""Stage 2 as a whole: how the scene moves, then the scene at rest as it looks in motion."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import Scene
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
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.pictures import clips
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.train_motion import train_motion
from devrf.reconstruct.watch import Watch

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
) -> tuple[MotionField, RestModel | None, dict[str, Any]]:
    """Motion, the scene at rest as it looks in motion (None: as it does at rest), and what was measured.

    Arguments and errors as `train_motion`'s, and `reference`: the camera whose clock is everyone's; without one no late
    camera is looked for.
    """
    searched = reference if options.find_late_camera else None
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
        return motion, None, metrics
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
    return motion, tuned.model, metrics


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
    curves = {name: moments.curves(motion, name, SHIFTS) for name in names}
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
    pictures = offset_pictures(Moments(scene, rest, options, device).curves(others, name, WIDE), WIDE)
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
    after = {camera: moments.curves(again, camera, shift[camera]) for camera in names}
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
