"""One picture laid on another by the small affine map that fits best, found in the pictures themselves.

Cameras that are wrong shift, turn and scale a picture. What such a map takes away of a difference is theirs; what
stays is not. Differences are linear in a small map (Lucas and Kanade, IJCAI 1981): coarse to fine, with weights that
keep what only one of the pictures shows from pulling.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, map_coordinates

BLURS_PX = (4.0, 2.0, 1.0)  # of both pictures, coarse to fine: maps of some 8 pixels and less are found
STEPS = 4  # at each of them
DAMPING = 1e-6  # plain pictures tell nothing: the map stays where it is


def aligned(
    picture: Float[np.ndarray, "height width channels"],
    to: Float[np.ndarray, "height width channels"],
    where: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width channels"]:
    """The picture as it lies best on another one, or as it is if no map lowers the squared error.

    Args:
        picture: To be moved, in [0, 1].
        to: What it is laid on.
        where: Pixels of `to` that are compared.
    """
    height, width = where.shape
    v, u = (np.mgrid[:height, :width] + 0.5 - np.array([height, width])[:, None, None] / 2) / max(
        height, width
    )
    basis = np.stack([np.ones_like(u), u, v], axis=-1)
    found = np.zeros((3, 2))  # of the basis, to pixels along x and y
    for blur in BLURS_PX:
        target = gaussian_filter(to, (blur, blur, 0))
        for _ in range(STEPS):
            here = gaussian_filter(_moved(picture, basis @ found), (blur, blur, 0))
            down, right = np.gradient(here, axis=(0, 1))
            slopes = np.stack([right, down], axis=-1)[where][:, :, None] * basis[where][:, None, :, None]
            left = (target - here)[where]
            weight = 1 / np.maximum(np.abs(left), np.median(np.abs(left)) + 1e-6)
            J, e, w = slopes.reshape(-1, 6), left.reshape(-1), weight.reshape(-1, 1)
            found = found + np.linalg.solve(
                J.T @ (w * J) + DAMPING * len(J) * np.eye(6), J.T @ (w[:, 0] * e)
            ).reshape(3, 2)
    moved = _moved(picture, basis @ found)
    before, after = (((p - to)[where] ** 2).mean() for p in (picture, moved))
    return moved if after < before else picture


def _moved(
    picture: Float[np.ndarray, "height width channels"], by: Float[np.ndarray, "height width 2"]
) -> Float[np.ndarray, "height width channels"]:
    """What the picture shows so many pixels to the right and below."""
    height, width, channels = picture.shape
    at = np.mgrid[:height, :width] + np.moveaxis(by[..., ::-1], -1, 0)
    return np.stack(
        [map_coordinates(picture[..., n], at, order=1, mode="nearest") for n in range(channels)], axis=-1
    )
