"""Stage 2 as a whole: how the scene moves, then the scene at rest as it looks in motion."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import Scene
from devrf.flow.store import CameraFlow
from devrf.reconstruct.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.clocks import LearnedClock, picture_gap_s, with_clocks
from devrf.reconstruct.fine_tune import fine_tune
from devrf.reconstruct.late_camera import (
    WIDE,
    Moments,
    fits_better,
    moved_by,
    of_camera,
    offset_pictures,
    suspect,
    without,
)
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.train_canonical import RestModel
from devrf.reconstruct.train_motion import train_motion
from devrf.reconstruct.watch import Watch

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
    clock_stds: Mapping[str, float | None] | None = None,
) -> tuple[MotionField, RestModel | None, dict[str, Any]]:
    """Motion, the scene at rest as it looks in motion (None: as it does at rest), and what was measured.

    Arguments and errors as `train_motion`'s.
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
        clock_stds,
    )
    if options.find_late_camera and clock_stds:
        motion, metrics, scene = _with_late_camera(
            scene, rest, flows, options, device, progress, checkpoint, clock_stds, motion, metrics
        )
    if not options.fine_tuning:
        return motion, None, metrics
    scene = with_clocks(scene, {name: LearnedClock(**c) for name, c in metrics.get("clocks", {}).items()})
    tuned = fine_tune(
        scene,
        rest,
        motion,
        options,
        device,
        lambda f, m: progress(share + (1 - share) * f, m),
        checkpoint.part("fine-tuning"),
    )
    metrics["decisions"] += [str(tuned.decision)] if tuned.decision is not None else []
    for name in ("seconds", "iterations", "rays"):
        metrics[name] += tuned.metrics[name]
    for name in ("peak_rss_gb", "peak_gpu_gb"):
        metrics[name] = max(metrics[name], tuned.metrics[name]) if metrics[name] is not None else None
    metrics["rays_per_s"] = round(metrics["rays"] / max(metrics["seconds"], 1e-9))
    metrics["restarts"] += tuned.metrics["restarts"]
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
    clock_stds: Mapping[str, float | None],
    motion: MotionField,
    metrics: dict[str, Any],
) -> tuple[MotionField, dict[str, Any], Scene]:
    """The same with the clock of one camera moved, if the motion that the others see says so."""
    reference, moments = next(iter(clock_stds)), Moments(scene, rest, options, device)
    name = suspect(moments, motion, reference)
    if name is None:
        return motion, metrics, scene
    coarse = replace(
        options, levels=options.levels[:1], iterations=options.iterations[:1], learn_clocks=False
    )
    others, _ = train_motion(
        without(scene, name),
        rest,
        flows,
        coarse,
        device,
        lambda f, m: progress(MOTION, f"without {name}: {m}"),
        checkpoint.part("others"),
    )
    pictures = offset_pictures(moments.curves(others, name, WIDE), WIDE)
    gap_s = picture_gap_s(of_camera(scene, name))
    if pictures == 0:
        return motion, metrics, scene
    moved = moved_by(scene, name, pictures * gap_s)
    again, new = train_motion(
        moved,
        rest,
        flows,
        options,
        device,
        lambda f, m: progress(MOTION, f"{name} moved: {m}"),
        checkpoint.part("moved"),
        clock_stds=clock_stds,
    )
    if not fits_better(moments, motion, replace(moments, scene=moved), again):
        return motion, metrics, scene
    return (
        again,
        new | {"late_camera": {"name": name, "pictures": pictures, "offset_s": pictures * gap_s}},
        moved,
    )
