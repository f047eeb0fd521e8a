"""Scenes for tests: of the pictures and of what is special about them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from devrf.capture.scene import PosedFrame, Scene

UNIT_BOX = np.array([[-1.0] * 3, [1.0] * 3])


def scene_of(
    static: Sequence[PosedFrame], dynamic: Sequence[PosedFrame] = (), scale: float = 1.0, **special: Any
) -> Scene:
    """A scene of these pictures: cameras around a unit box in which things move for a second.

    Args:
        static, dynamic: Pictures at rest and in motion.
        scale: Box units in a world unit.
        special: Other values than the usual ones.
    """
    usual = {
        "box_from_world": np.diag([scale] * 3 + [1.0]),
        "aabb": UNIT_BOX,
        "near": 0.1,
        "far": 4.0,
        "kind": "inward",
    }
    usual |= {"background": "shell", "t0_s": 0.0, "t1_s": 1.0, "rest_time": 0.0, "image_scale": 1.0}
    return Scene(tuple(static), tuple(dynamic), **(usual | special))
