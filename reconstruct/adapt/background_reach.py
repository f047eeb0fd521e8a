"""How far the surroundings of the box are modelled."""

import numpy as np
from jaxtyping import Float

from devrf.capture.scene import Scene
from devrf.reconstruct.fields.contracted_background import REACH
from devrf.reconstruct.sampling.pictures import training

FARTHEST_REACH = 24.0  # beyond, depth gets too coarse near the box; and parallax is small
REACH_PERCENTILE = 98.0  # of the points' distances: a few are wrong
REACH_MARGIN = 1.15  # walls are a little behind what stands before them


def reach_of(scene: Scene) -> float:
    """How far the surroundings are modelled, in half sizes of the box: to training cameras and the farthest points.

    Args:
        scene: In the box frame.
    """
    lo, hi = scene.aabb

    def away(xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return np.abs((xyz - (lo + hi) / 2) * 2 / (hi - lo)).max(axis=1)

    if scene.points is None or not len(scene.points.xyz):
        return FARTHEST_REACH  # nobody knows where walls are: what is far hardly moves against what is near
    cameras = away(np.array([frame.camera.centre for frame in training(scene.frames)]))
    farthest = max(float(cameras.max()), float(np.percentile(away(scene.points.xyz), REACH_PERCENTILE)))
    return min(max(REACH, REACH_MARGIN * farthest), FARTHEST_REACH)
