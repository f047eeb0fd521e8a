"""Where the surroundings of one camera begin: nearer than the box and than all of the points that it sees.

Right in front of a camera that nobody trained on no other may ever have looked, and what training left there is fog.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene

SHARE = 0.8  # of the nearest point's distance; of nearly all points' for the whole scene (calibration/extent/bounds.py)
FEWEST = 50  # points that a camera sees, from which they say anything: nobody found any on a plain wall
MOST = 1 << 15  # points that are kept, 200 kB: a plain box right before a camera had six of 5000


def points_of(scene: Scene) -> Float[Tensor, "n 3"]:
    """Some of the sparse points of a scene in the box frame, in no order."""
    xyz = np.zeros((0, 3)) if scene.points is None else scene.points.xyz
    chosen = np.random.default_rng(0).permutation(len(xyz))[:MOST]
    return torch.from_numpy(xyz[chosen].astype(np.float32))


def near_plane(
    camera: Camera, points: Float[Tensor, "n 3"], aabb: Float[Tensor, "2 3"], least: float
) -> float:
    """Distance from the camera at which its rays begin to meet surroundings.

    Args:
        camera: In the box frame.
        points: Of the scene, in the box frame; with few in the camera's picture it is `least`.
        aabb: The box, which is never cut.
        least: Of all cameras.
    """
    xyz = points.double().numpy()
    shown = camera.in_picture(camera.project(xyz))
    if shown.sum() < FEWEST:
        return least
    away = SHARE * float(np.linalg.norm(xyz[shown] - camera.centre, axis=1).min())
    lo, hi = aabb.double().numpy()
    to_box = float(np.linalg.norm(np.clip(camera.centre, lo, hi) - camera.centre))
    return max(least, min(away, to_box))
