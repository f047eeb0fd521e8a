"""Where a stage that trains keeps its state, in the run folder beside the finished stages."""

from dataclasses import asdict
from pathlib import Path

from devrf.pipelines.stage import StageContext
from devrf.pipelines.stamps.stamp import identity_key
from devrf.reconstruct.options import CanonicalOptions, MotionOptions
from devrf.reconstruct.storage.checkpoint import Checkpoint


def checkpoint_path(run_dir: Path, stage: str) -> Path:
    """Where a stage's training keeps its state."""
    return run_dir / f".{stage}.safetensors"


def training_checkpoint(
    context: StageContext, stage: str, asked: CanonicalOptions | MotionOptions
) -> Checkpoint:
    """Of one training: its fingerprint is of all that the stage is made from, the options asked for and the device.

    The file stays until the stage's folder has its name. The training ends, and can go on, when the run's time is over.
    """
    of = {"made_from": context.made_from, "options": asdict(asked), "device": context.device}
    checkpoint = Checkpoint(
        checkpoint_path(context.run_dir, stage), identity_key(stage, of), until=context.allowance.until
    )
    context.afterwards.append(checkpoint.remove)
    return checkpoint
