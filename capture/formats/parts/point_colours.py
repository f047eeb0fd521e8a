"""Colours of sparse points, from the pictures that show them: splats and viewers begin with them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.scene import PosedFrame, SparsePoints

UNKNOWN = 128  # grey, of a point that no picture shows


def point_colours(points: SparsePoints, static: Sequence[PosedFrame]) -> UInt8[np.ndarray, "points 3"]:
    """sRGB of every point, the mean of the nearest pixels in the pictures that show it.

    Args:
        points: What is seen.
        static: The pictures that `points.obs_frame` counts.
    Raises:
        CaptureError: A picture cannot be read.
    """
    total, count = np.zeros((len(points.xyz), 3)), np.zeros(len(points.xyz))
    for n in np.unique(points.obs_frame):
        camera = static[n].camera
        seen = points.obs_point[points.obs_frame == n]
        at = camera.project(points.xyz[seen])
        inside = camera.in_picture(at)
        columns, rows = at[inside].astype(int).T
        np.add.at(total, seen[inside], read_pixels(static[n].path)[rows, columns, :3])
        np.add.at(count, seen[inside], 1)
    mean = total / np.maximum(count, 1)[:, None]
    return np.where(count[:, None] > 0, mean.round(), UNKNOWN).astype(np.uint8)
