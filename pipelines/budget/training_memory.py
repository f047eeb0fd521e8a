"""The memory that a stage may train with, and options that keep below it."""

import json
import os
from dataclasses import asdict, dataclass, replace
from typing import Any

from devrf.capture.scene import Scene
from devrf.capture.system.processes import memory_of
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.adapt.footprint import SceneSize
from devrf.reconstruct.adapt.memory_fit import Limits, Options, fitted
from devrf.reconstruct.storage.checkpoint import Checkpoint


@dataclass(frozen=True)
class TrainingMemory:
    """What a training may take, looked at before anything is loaded: predictions count all that it loads.

    Attributes:
        limits: Of main memory with the process around it, and of the GPU.
        held: Main memory that the process holds already, bytes.
    """

    limits: Limits
    held: int

    @staticmethod
    def now(context: StageContext) -> "TrainingMemory":
        """As it is now."""
        return TrainingMemory(Limits(context.allowance.memory, _gpu_bytes(context)), memory_of([os.getpid()]))


def fit_to_memory(
    context: StageContext,
    scene: Scene | SceneSize,
    asked: Options,
    memory: TrainingMemory,
    checkpoint: Checkpoint,
) -> tuple[Options, list[str]]:
    """Options with which the training stays below what is allowed, and what was decided; it is said, too.

    A training that was begun goes on with what it was begun with, as long as that fits; this is said, too. The
    checkpoint is told.

    Raises:
        ReconstructError: Even the smallest training takes more.
    """
    begun = checkpoint.begun()
    before = None if begun is None else _with(asked, begun.chosen["options"])
    found = fitted(scene, asked, memory.limits, context.device, memory.held, before)
    lines = [str(decision) for decision in found.decisions]
    if begun is not None and found.options is before:
        context.say(f"  goes on from its checkpoint, after step {begun.done}")
        lines = begun.chosen["decisions"]
    for line in lines:
        context.say(f"  {line}")
    checkpoint.chosen = {"options": _otherwise(found.options, asked), "decisions": lines}
    return found.options, lines


def _otherwise(options: Options, asked: Options) -> dict[str, Any]:
    """What is other than was asked for, as JSON has it."""
    before = asdict(asked)
    changed = {name: value for name, value in asdict(options).items() if value != before[name]}
    return json.loads(json.dumps(changed))


def _with(asked: Options, changed: dict[str, Any]) -> Options:
    """The options again."""
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in changed.items()}
    return replace(asked, **values)


def _gpu_bytes(context: StageContext) -> int | None:
    """What PyTorch may take beside its tensors: of `budget.gpu_memory_gb`, and of what is free.

    Memory that it has reserved and no tensor holds is taken again, or given back, before it asks for more.
    """
    if context.device == "cpu":
        return None
    import torch

    allocated = torch.cuda.memory_allocated()
    free = torch.cuda.mem_get_info()[0] + torch.cuda.memory_reserved() - allocated
    budget = context.allowance.gpu
    return free if budget is None else max(0, min(free, budget - allocated))
