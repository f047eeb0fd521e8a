"""How far the surroundings of the box are modelled."""

import numpy as np
from jaxtyping import Float

from devrf.capture.scene import Scene
from devrf.reconstruct.fields.contracted_background import REACH
from devrf.reconstruct.kernels.background import Contraction
from devrf.reconstruct.sampling.pictures import training

FARTHEST_REACH = 24.0  # beyond, depth gets too coarse near the box; and parallax is small
# Of the points' distances: of most, and of all but those that are wrong. Two in a hundred can be all that windows show.
MOST, ALL = 95.0, 99.5
REACH_MARGIN = 1.15  # walls are a little behind what stands before them


def contraction_of(scene: Scene) -> Contraction:
    """How space is contracted: it reaches to training cameras and to the farthest points, and is bent where most end.

    Args:
        scene: In the box frame.
    """
    lo, hi = scene.aabb

    def away(xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return np.abs((xyz - (lo + hi) / 2) * 2 / (hi - lo)).max(axis=1)

    # Without points walls may be anywhere: what is far hardly moves against what is near.
    ends = [0.0, np.inf]
    if scene.points is not None and len(scene.points.xyz):
        ends = np.percentile(away(scene.points.xyz), [MOST, ALL]).tolist()
    cameras = float(away(np.array([frame.camera.centre for frame in training(scene.frames)])).max())
    bend, reach = (min(max(REACH, REACH_MARGIN * max(cameras, end)), FARTHEST_REACH) for end in ends)
    return Contraction(reach, bend)
