"""The memory that a stage may train with, and options that keep below it."""

from typing import TypeVar

from devrf.capture.scene import Scene
from devrf.pipelines.budget.memory import resident_bytes
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.memory_fit import Limits, fitted
from devrf.reconstruct.options import CanonicalOptions, MotionOptions

Options = TypeVar("Options", CanonicalOptions, MotionOptions)


def fit_to_memory(context: StageContext, scene: Scene, options: Options) -> tuple[Options, list[str]]:
    """Options with which the training stays below what is allowed, and what was decided; it is said, too.

    Raises:
        ReconstructError: Even the smallest training takes more.
    """
    limits = Limits(context.allowance.memory, _gpu_bytes(context))
    options, decisions = fitted(scene, options, limits, context.device, resident_bytes())
    lines = [str(decision) for decision in decisions]
    for line in lines:
        context.say(f"  {line}")
    return options, lines


def _gpu_bytes(context: StageContext) -> int | None:
    """`budget.gpu_memory_gb`, else what is free."""
    if context.device == "cpu":
        return None
    import torch

    free, _ = torch.cuda.mem_get_info()
    return free if context.allowance.gpu is None else min(free, context.allowance.gpu)
