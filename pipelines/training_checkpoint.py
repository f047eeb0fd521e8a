"""Where a stage that trains keeps its state, in the run folder beside the finished stages."""

import hashlib
import json
from dataclasses import asdict

from devrf.pipelines.stage import StageContext
from devrf.reconstruct.checkpoint import Checkpoint
from devrf.reconstruct.options import CanonicalOptions, MotionOptions


def training_checkpoint(
    context: StageContext, stage: str, options: CanonicalOptions | MotionOptions
) -> Checkpoint:
    """Of one training: its fingerprint is of all that the stage is made from, its options and the device.

    The file stays until the stage's folder has its name.
    """
    of = [context.made_from, asdict(options), context.device]
    digest = hashlib.sha256(json.dumps(of, sort_keys=True).encode()).hexdigest()
    checkpoint = Checkpoint(context.run_dir / f".{stage}.safetensors", digest)
    context.afterwards.append(checkpoint.remove)
    return checkpoint
