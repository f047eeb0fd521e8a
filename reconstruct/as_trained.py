"""The scene with the times that its motion was learned with."""

from collections.abc import Mapping
from typing import Any

from devrf.capture.scene import Scene
from devrf.reconstruct.clocks import retimed


def as_trained(scene: Scene, metrics: Mapping[str, Any]) -> Scene:
    """Move the clocks that training moved; only training pictures have other times then.

    Args:
        scene: As `scene` left it.
        metrics: What `train_deformation` measured; nothing of offsets in there: all clocks stay.
    """
    return retimed(scene, metrics.get("clock_offsets_s", {}))
