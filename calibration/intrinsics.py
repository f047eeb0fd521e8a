"""Intrinsics of one device: focal lengths, principal point, lens model and its distortion.

The centre of the top-left pixel is (0.5, 0.5); OpenCV counts it as (0, 0): `cv_matrix` is half a pixel less.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera, LensModel, undistort
from devrf.capture.orientation import Upright

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Intrinsics:
    """What a device does to rays.

    Attributes:
        width, height: Picture size, pixels.
        K: [3, 3], pixels.
        distortion: k1, k2, p1, p2, k3 [5]; of a fisheye lens k1, k2, k3, k4, 0.
        std: Standard deviation of each of `PARAMETERS` [9], a fisheye lens's k3, k4 in the places of p1, p2;
            None where it is not known.
        model: As of `Camera`.
    """

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    std: Float[np.ndarray, "9"] | None = None
    model: LensModel = "OPENCV"

    @property
    def vector(self) -> Float[np.ndarray, "9"]:
        """`PARAMETERS` as one vector [9]."""
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.distortion])

    @property
    def cv_matrix(self) -> Float[np.ndarray, "3 3"]:
        """K as OpenCV wants it (centre of the first pixel at 0)."""
        return self.K - HALF_PIXEL

    def at(self, cam_from_world: Float[np.ndarray, "3 4"]) -> Camera:
        """A camera with these intrinsics at a pose."""
        return Camera(self.width, self.height, self.K, cam_from_world, self.distortion, self.model)

    def turned(self, upright: Upright) -> "Intrinsics":
        """The same device's, in pictures that were turned and mirrored so."""
        if upright.nothing:
            return self
        turn, size = upright.matrix, upright.size(self.width, self.height)
        K = np.eye(3)
        K[[0, 1], [0, 1]] = np.abs(turn) @ self.K[[0, 1], [0, 1]]
        K[:2, 2] = upright.points(self.K[:2, 2], self.width, self.height)
        distortion, std = self.distortion.copy(), None if self.std is None else self.std.copy()
        if self.model == "OPENCV":  # (p2, p1) is a direction in the picture
            distortion[[3, 2]] = turn @ distortion[[3, 2]]
        if std is not None:
            for pair in ([0, 1], [2, 3], *([[7, 6]] if self.model == "OPENCV" else [])):
                std[pair] = np.abs(turn) @ std[pair]
        return Intrinsics(*size, K, distortion, std, self.model)

    def undistorted(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Where a pinhole camera with the same K would have seen pixels [n, 2]; for solvers that know no lenses."""
        x = (xy - self.K[:2, 2]) / np.diag(self.K)[:2]
        return undistort(x, self.distortion, self.model) * np.diag(self.K)[:2] + self.K[:2, 2]


def from_vector(
    width: int,
    height: int,
    vector: Float[np.ndarray, "9"],
    std: Float[np.ndarray, "9"] | None = None,
    model: LensModel = "OPENCV",
) -> Intrinsics:
    """Inverse of `Intrinsics.vector`."""
    fx, fy, cx, cy = vector[:4]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Intrinsics(width, height, K, np.array(vector[4:], dtype=np.float64), std, model)


def guess(width: int, height: int, focal_px: float | None = None, pixel_aspect: float = 1.0) -> Intrinsics:
    """A start without calibration: centred, undistorted, focal 1.2 x the longer side (COLMAP's guess).

    Args:
        width, height: Picture size, pixels.
        focal_px: Focal length, in widths of a pixel.
        pixel_aspect: Width of a pixel over its height.
    """
    fx = focal_px or 1.2 * max(width, height / pixel_aspect)
    lens = [fx, pixel_aspect * fx, width / 2, height / 2, 0.0, 0.0, 0.0, 0.0, 0.0]
    return from_vector(width, height, np.array(lens))
