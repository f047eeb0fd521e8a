"""A camera: intrinsics, lens distortion and pose. The only place that projects.

Axes are OpenCV's (x right, y down, z forward); `cam_from_world` takes world points into the camera.
Pixel (0, 0) has its centre at (0.5, 0.5), so `K` here is OpenCV's K with 0.5 added to cx and cy.
Distortion is OpenCV's, under COLMAP's names of the models: `OPENCV` is k1, k2, p1, p2, k3 (Brown-Conrady;
OpenCV documentation, "calib"), `OPENCV_FISHEYE` is k1, k2, k3, k4, 0 (Kannala and Brandt, PAMI 2006, as in
OpenCV's namespace fisheye: an image radius of theta (1 + k1 theta^2 + k2 theta^4 + ...) at angle theta).
"""

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

LensModel = Literal["OPENCV", "OPENCV_FISHEYE"]

UNDISTORT_ITERATIONS = 12  # Newton steps; three to five are used for usual lenses
WIDEST_IDEAL = np.radians(89.9)  # normalised coordinates end where rays are parallel to the picture's plane
RIGID_TOLERANCE = 1e-4  # |R R^T - I|; poses read from text files carry about 1e-6


@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    Attributes:
        width, height: Picture size, pixels.
        K: Intrinsics [3, 3], pixels; the centre of the top-left pixel is (0.5, 0.5).
        cam_from_world: Rigid transform [3, 4].
        distortion: k1, k2, p1, p2, k3 [5]; of a fisheye lens k1, k2, k3, k4, 0.
        model: `OPENCV` or `OPENCV_FISHEYE`.
    """

    width: int
    height: int
    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "3 4"]
    distortion: Float[np.ndarray, "5"] = field(default_factory=lambda: np.zeros(5))
    model: LensModel = "OPENCV"

    def __post_init__(self) -> None:
        if self.model not in get_args(LensModel):
            text = f"camera.model is {self.model}, expected one of {', '.join(get_args(LensModel))}"
            raise ValueError(text)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size is {self.width}x{self.height}, expected at least 1x1")
        for name, shape in (("K", (3, 3)), ("cam_from_world", (3, 4)), ("distortion", (5,))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"camera.{name} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"camera.{name} is not finite: {value.tolist()}")
            object.__setattr__(self, name, value)
        if not (f := np.diag(self.K)[:2]).min() > 0:
            raise ValueError(f"camera.K has focal lengths {f[0]:g}, {f[1]:g}, expected more than 0")
        R = self.cam_from_world[:, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
            raise ValueError(f"camera.cam_from_world is not rigid: R = {R.tolist()}")

    @property
    def view(self) -> tuple[object, ...]:
        """Pose and lens: the same for pictures of a camera that stands still."""
        return (self.cam_from_world.tobytes(), *self.lens)

    @property
    def lens(self) -> tuple[object, ...]:
        """What makes two cameras see the same rays from the same pose; hashable."""
        return (self.width, self.height, self.model, self.K.tobytes(), self.distortion.tobytes())

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Position of the camera in the world [3]."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    @property
    def fov_y(self) -> float:
        """Angle that its picture is high, radians; without distortion."""
        return float(2 * np.arctan(self.height / 2 / self.K[1, 1]))

    @property
    def world_from_cam(self) -> Float[np.ndarray, "4 4"]:
        """Inverse pose [4, 4]."""
        out = np.eye(4)
        out[:3, :3] = self.cam_from_world[:, :3].T
        out[:3, 3] = self.centre
        return out

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Project world points [..., 3] to pixels [..., 2]; NaN at or behind the camera."""
        p = points @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        x = distort(p[..., :2] / z[..., None], self.distortion, self.model)
        return x @ self.K[:2, :2].T + self.K[:2, 2]

    def in_picture(self, pixels: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Which pixels [..., 2] lie in the picture; not those of points behind the camera, which are NaN."""
        return np.asarray(((pixels >= 0) & (pixels < [self.width, self.height])).all(axis=-1))

    def directions(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit viewing directions [..., 3] in the world through pixels [..., 2]."""
        x = (pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        if self.model == "OPENCV_FISHEYE":  # by the angle, which may pass 90 degrees
            theta, r = _fisheye_angle(x, self.distortion)
            across = np.sin(theta) / np.where(r > 0, r, 1.0)
            d = np.concatenate([x * across, np.cos(theta)], axis=-1)
        else:
            x = undistort(x, self.distortion)
            d = np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
        d = d @ self.cam_from_world[:, :3]
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def scaled(self, scale: float) -> "Camera":
        """The same camera after its pictures were resized by `scale` (sizes are rounded)."""
        width, height = max(1, round(self.width * scale)), max(1, round(self.height * scale))
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return replace(self, width=width, height=height, K=K)

    def moved(self, new_from_world: Float[np.ndarray, "4 4"]) -> "Camera":
        """The same camera seen from a world mapped by the similarity `new_from_world` [4, 4]."""
        scale = np.cbrt(np.linalg.det(new_from_world[:3, :3]))
        R = self.cam_from_world[:, :3] @ (new_from_world[:3, :3] / scale).T
        centre = new_from_world[:3, :3] @ self.centre + new_from_world[:3, 3]
        return replace(self, cam_from_world=np.column_stack([R, -R @ centre]))


def distort(
    x: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5"], model: LensModel = "OPENCV"
) -> Float[np.ndarray, "*batch 2"]:
    """Ideal to distorted normalised coordinates [..., 2]."""
    return _fisheye(x, distortion) if model == "OPENCV_FISHEYE" else _brown_conrady(x, distortion)


def distort_many(
    x: Float[np.ndarray, "n 2"], distortion: Float[np.ndarray, "n 5"], fisheye: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """`distort` with a lens per point; `fisheye` says whose model is `OPENCV_FISHEYE`."""
    if not fisheye.any():
        return _brown_conrady(x, distortion.T)
    return np.where(fisheye[:, None], _fisheye(x, distortion.T[..., None]), _brown_conrady(x, distortion.T))


def undistort(
    x: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5"], model: LensModel = "OPENCV"
) -> Float[np.ndarray, "*batch 2"]:
    """Distorted to ideal normalised coordinates [..., 2], by Newton's method.

    Ideal coordinates of a fisheye lens end at `WIDEST_IDEAL` from the axis; `Camera.directions` goes on.
    """
    if model == "OPENCV_FISHEYE":
        theta, r = _fisheye_angle(x, distortion)
        return x * np.tan(np.minimum(theta, WIDEST_IDEAL)) / np.where(r > 0, r, 1.0)
    if not np.any(distortion):
        return x.copy()
    ideal, eps = x.copy(), 1e-6
    for _ in range(UNDISTORT_ITERATIONS):
        residual = distort(ideal, distortion) - x
        if np.abs(residual).max(initial=0) < 1e-12:
            break
        du = (distort(ideal + [eps, 0], distortion) - residual - x) / eps
        dv = (distort(ideal + [0, eps], distortion) - residual - x) / eps
        det = du[..., 0] * dv[..., 1] - dv[..., 0] * du[..., 1]
        det = np.where(np.abs(det) < 1e-3, 1e-3, det)  # beyond the lens model's fold: step back, do not leap
        step_u = (residual[..., 0] * dv[..., 1] - residual[..., 1] * dv[..., 0]) / det
        step_v = (residual[..., 1] * du[..., 0] - residual[..., 0] * du[..., 1]) / det
        ideal = ideal - np.clip(np.stack([step_u, step_v], axis=-1), -0.5, 0.5)
    return ideal


def _brown_conrady(
    x: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5 ..."]
) -> Float[np.ndarray, "*batch 2"]:
    k1, k2, p1, p2, k3 = distortion
    u, v = x[..., 0], x[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    du = 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return np.stack([u * radial + du, v * radial + dv], axis=-1)


def _fisheye(
    x: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5 ..."]
) -> Float[np.ndarray, "*batch 2"]:
    r = np.hypot(x[..., :1], x[..., 1:])
    theta = np.arctan(r)
    ratio = np.where(r > 0, theta / np.where(r > 0, r, 1.0), 1.0)
    return x * ratio * _radius(theta, distortion)[0]


def _fisheye_angle(
    x: Float[np.ndarray, "*batch 2"], distortion: Float[np.ndarray, "5"]
) -> tuple[Float[np.ndarray, "*batch 1"], Float[np.ndarray, "*batch 1"]]:
    """Angle from the axis [..., 1], radians, at distorted coordinates, and their distance [..., 1] from the axis."""
    r = np.hypot(x[..., :1], x[..., 1:])
    theta = np.minimum(r, np.pi)
    for _ in range(UNDISTORT_ITERATIONS):
        ratio, slope = _radius(theta, distortion)
        error = theta * ratio - r
        if np.abs(error).max(initial=0) < 1e-12:
            break
        slope = np.where(np.abs(slope) < 0.1, 0.1, slope)  # beyond the lens model's fold: step back
        theta = np.clip(theta - np.clip(error / slope, -0.5, 0.5), 0.0, np.pi)
    return theta, r


def _radius(
    theta: Float[np.ndarray, "*batch 1"], distortion: Float[np.ndarray, "5 ..."]
) -> tuple[Float[np.ndarray, "*batch 1"], Float[np.ndarray, "*batch 1"]]:
    """A fisheye lens's image radius over theta, and the radius's derivative by theta."""
    k1, k2, k3, k4, _ = distortion
    t2 = theta * theta
    ratio = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    return ratio, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
