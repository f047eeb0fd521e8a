"""A scene's work in pieces that need the same machine: stages before the first that trains, and those from it on."""

from collections.abc import Sequence
from dataclasses import dataclass

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.runner.plan import Standing


@dataclass(frozen=True)
class Group:
    """Consecutive stages that run in one process.

    Attributes:
        stages: Their names.
        gpu: Whether they are to have a GPU.
    """

    stages: tuple[str, ...]
    gpu: bool


def groups(config: SceneConfig, standing: Sequence[Standing], gpu: bool) -> list[Group]:
    """What is left to do of a scene.

    Stages that are fresh are left out at the beginning only: those later on cost nothing to pass.

    Args:
        config: The scene.
        standing: Where its stages that are to run stand.
        gpu: Whether there are GPUs. Without, one process does it all.
    """
    trains = "flow" if config.flow.method != "dis" else "canonical"  # the first stage that uses a GPU
    names = [now.stage.name for now in standing]
    todo = next((n for n, now in enumerate(standing) if now.state in ("stale", "missing")), len(names))
    first = next((n for n, name in enumerate(names) if name == trains), len(names))
    if not gpu:
        return [Group(tuple(names[todo:]), False)] if todo < len(names) else []
    parts = ((tuple(names[todo:first]), False), (tuple(names[max(first, todo) :]), True))
    return [Group(stages, on_gpu) for stages, on_gpu in parts if stages]
