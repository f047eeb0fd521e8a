"""Stage 2 as a whole: how the scene moves, then the scene at rest as it looks in motion."""

from collections.abc import Mapping
from typing import Any

from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import Scene
from devrf.flow.store import CameraFlow
from devrf.reconstruct.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.clocks import LearnedClock, with_clocks
from devrf.reconstruct.fine_tune import fine_tune
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
