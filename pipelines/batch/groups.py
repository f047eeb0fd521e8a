"""A scene's work in pieces that need the same machine: those before the first that uses a GPU, and the rest."""

from collections.abc import Sequence

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.runner.plan import Standing

ON_GPU = {"canonical", "deformation", "evaluate", "render"}  # and flow, but by OpenCV's DIS


def groups(
    config: SceneConfig, standing: Sequence[Standing], gpu: bool
) -> list[tuple[tuple[str, ...], bool]]:
    """What is left to do of a scene: names of consecutive stages that run in one process, and whether on a GPU.

    Stages that are fresh are left out at the beginning only: those later on cost nothing to pass.

    Args:
        config: The scene.
        standing: Where its stages that are to run stand.
        gpu: Whether there are GPUs. Without, one process does it all.
    """
    faster = ON_GPU if config.flow.method == "dis" else ON_GPU | {"flow"}
    first = next((n for n, now in enumerate(standing) if now.to_make), len(standing))
    todo = tuple(now.stage.name for now in standing[first:])
    split = next((n for n, name in enumerate(todo) if gpu and name in faster), len(todo))
    return [(stages, on_gpu) for stages, on_gpu in ((todo[:split], False), (todo[split:], True)) if stages]
