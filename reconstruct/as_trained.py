"""The scene with the times that its motion was learned with."""

from collections.abc import Mapping
from typing import Any

from devrf.capture.scene import Scene
from devrf.reconstruct.late_camera import moved_by


def as_trained(scene: Scene, metrics: Mapping[str, Any]) -> Scene:
    """Move the clock that training moved; only training pictures have other times then.

    Args:
        scene: As `scene` left it.
        metrics: What `train_deformation` measured; nothing of a late camera in there: all clocks stay.
    """
    late = metrics.get("late_camera")
    return scene if late is None else moved_by(scene, late["name"], late["offset_s"])
