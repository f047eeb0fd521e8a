"""A scene's work in pieces that need the same machine: those before the first that uses a GPU, and the rest."""

from collections.abc import Sequence
from dataclasses import dataclass

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.runner.plan import Standing

ON_GPU = {"canonical", "deformation", "evaluate", "render"}  # and flow, but by OpenCV's DIS


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
    faster = ON_GPU if config.flow.method == "dis" else ON_GPU | {"flow"}
    first = next((n for n, now in enumerate(standing) if now.to_make), len(standing))
    todo = [now.stage.name for now in standing[first:]]
    split = next((n for n, name in enumerate(todo) if gpu and name in faster), len(todo))
    parts = ((todo[:split], False), (todo[split:], True))
    return [Group(tuple(stages), on_gpu) for stages, on_gpu in parts if stages]
