# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""What pictures want of points, added up: squares of residuals in pixels and in brightness, by the points' places.

Residuals weigh less beyond a length (Huber 1964). Derivatives leave out the lens's distortion, which changes little
from pixel to pixel.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int

from devrf.capture.camera import Camera
from devrf.reconstruct.kernels.launch import array, launch, use_warp
from devrf.reconstruct.tracking.solver.normal_equations import Pulls

CPU = torch.device("cpu")


@dataclass(frozen=True)
class SeenPoints:
    """Points that a picture shows.

    Attributes:
        points: Their numbers, each once.
        xyz: Where they are when the picture is taken.
        at: The same in the picture, in pixels; NaN behind the camera.
        camera: The picture's.
        share: How far they go with a move of the moment's points.
    """

    points: Int[np.ndarray, " m"]
    xyz: Float[np.ndarray, "m 3"]
    at: Float[np.ndarray, "m 2"]
    camera: Camera
    share: float

    def derivative(self) -> Float[np.ndarray, "m 2 3"]:
        """Of `at` by the moves of the moment's points."""
        return self.share * derivative(self.camera, self.xyz)


class Sum:
    """Quadratics of points, added up: x^T H x / 2 + b^T x of their moves."""

    def __init__(self, points: int) -> None:
        self.hessian, self.gradient = np.zeros((points, 3, 3)), np.zeros((points, 3))

    def add_places(
        self,
        seen: SeenPoints,
        target: Float[np.ndarray, "m 2"],
        weight: Float[np.ndarray, " m"],
        huber: float,
    ) -> None:
        """Points should be at `target`, in pixels; those farther off than `huber` pixels weigh less."""
        if use_warp(CPU):
            self._launch(_places, seen, [(target, wp.vec2d), (weight, wp.float64)], [huber])
            return
        residual = seen.at - target
        weight = weight * huber_weight(np.linalg.norm(residual, axis=1), huber)
        self._add(seen.points, seen.derivative(), residual, weight)

    def add_brightness(
        self,
        seen: SeenPoints,
        apart: Float[np.ndarray, "m 3"],
        slope: Float[np.ndarray, "m 3 2"],
        begin: Float[np.ndarray, "m 2"],
        weight: float,
        huber: float,
    ) -> None:
        """Points should look as they are drawn.

        Args:
            seen: The points.
            apart: By how much they look brighter at `begin`.
            slope: Derivative of that by pixels.
            begin: In pixels.
            weight: Of the square of `apart`.
            huber: Of `apart`; what differs more weighs less.
        """
        if use_warp(CPU):
            arrays = [
                (apart, wp.vec3d),
                (slope.reshape(-1, 6), wp.types.vector(6, wp.float64)),
                (begin, wp.vec2d),
            ]
            self._launch(_brightness, seen, arrays, [weight, huber])
            return
        residual = apart + np.einsum("mij,mj->mi", slope, seen.at - begin)
        each = weight * huber_weight(np.abs(residual).max(1), huber)
        self._add(seen.points, slope @ seen.derivative(), residual, each)

    def join(self, other: "Sum") -> None:
        """Add all of another's."""
        self.hessian += other.hessian
        self.gradient += other.gradient

    def of(self, points: Bool[np.ndarray, " p"] | None = None) -> Pulls:
        """What some of the points want; None: all of them."""
        if points is None:
            return Pulls(self.hessian, self.gradient)
        return Pulls(self.hessian * points[:, None, None], self.gradient * points[:, None])

    def _add(
        self, points: np.ndarray, jacobian: np.ndarray, residual: np.ndarray, weight: np.ndarray
    ) -> None:
        """Add weighted squares of residuals [m, r] with derivatives [m, r, 3]."""
        fine = np.isfinite(residual).all(1) & np.isfinite(jacobian).all((1, 2)) & np.isfinite(weight)
        points, jacobian, residual, weight = (x[fine] for x in (points, jacobian, residual, weight))
        weighted = jacobian * weight[:, None, None]
        self.hessian[points] += weighted.mT @ jacobian
        self.gradient[points] += (weighted.mT @ residual[..., None])[..., 0]

    def _launch(self, kernel: object, seen: SeenPoints, arrays: list, numbers: list[float]) -> None:
        """The same by a kernel: every point adds to its own entry."""
        if not len(seen.points):
            return
        camera = seen.camera
        every = [(seen.points, wp.int64), (seen.xyz, wp.vec3d), (seen.at, wp.vec2d), *arrays]
        kept = [
            torch.from_numpy(np.ascontiguousarray(x, np.int64 if kind is wp.int64 else np.float64))
            for x, kind in every
        ]
        sums = torch.from_numpy(self.hessian), torch.from_numpy(self.gradient)
        pose = wp.mat33d(camera.cam_from_world[:, :3].ravel()), wp.vec3d(camera.cam_from_world[:, 3])
        lens = wp.vec2d(camera.K[0, 0] * seen.share, camera.K[1, 1] * seen.share)
        arguments = [
            *(array(x, kind) for x, (_, kind) in zip(kept, every, strict=True)),
            *pose,
            lens,
            *(wp.float64(x) for x in numbers),
            array(sums[0], wp.mat33d),
            array(sums[1], wp.vec3d),
        ]
        launch(kernel, len(seen.points), arguments, CPU)


def derivative(camera: Camera, xyz: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2 3"]:
    """Of pixels by points, without the lens's distortion."""
    R = camera.cam_from_world[:, :3]
    x, y, z = (xyz @ R.T + camera.cam_from_world[:, 3]).T
    fx, fy, zero = camera.K[0, 0], camera.K[1, 1], np.zeros_like(z)
    rows = [[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]]
    return np.stack([np.stack(row, -1) for row in rows], -2) @ R


def huber_weight(length: np.ndarray, least: float) -> np.ndarray:
    """Weight of a residual of a length: 1, and less beyond `least`."""
    return np.minimum(1, least / np.maximum(length, 1e-9))


@wp.func
@no_type_check
def _rows(x: wp.vec3d, R: wp.mat33d, t: wp.vec3d, lens: wp.vec2d):
    """Derivatives of both pixel coordinates by a point's place."""
    p = R * x + t
    deep = wp.vec3d(R[2, 0], R[2, 1], R[2, 2])
    along = lens[0] / p[2] * (wp.vec3d(R[0, 0], R[0, 1], R[0, 2]) - p[0] / p[2] * deep)
    down = lens[1] / p[2] * (wp.vec3d(R[1, 0], R[1, 1], R[1, 2]) - p[1] / p[2] * deep)
    return along, down


@wp.kernel(enable_backward=False)
@no_type_check
def _places(
    first: int,
    points: wp.array(dtype=wp.int64),
    xyz: wp.array(dtype=wp.vec3d),
    at: wp.array(dtype=wp.vec2d),
    target: wp.array(dtype=wp.vec2d),
    weight: wp.array(dtype=wp.float64),
    R: wp.mat33d,
    t: wp.vec3d,
    lens: wp.vec2d,
    huber: wp.float64,
    hessian: wp.array(dtype=wp.mat33d),
    gradient: wp.array(dtype=wp.vec3d),
):
    m = first + wp.tid()
    off = at[m] - target[m]
    length = wp.length(off)
    if not wp.isfinite(length) or not wp.isfinite(weight[m]):
        return
    w = weight[m] * wp.min(wp.float64(1.0), huber / wp.max(length, wp.float64(1.0e-9)))
    along, down = _rows(xyz[m], R, t, lens)
    p = int(points[m])
    hessian[p] += w * (wp.outer(along, along) + wp.outer(down, down))
    gradient[p] += w * (off[0] * along + off[1] * down)


@wp.kernel(enable_backward=False)
@no_type_check
def _brightness(
    first: int,
    points: wp.array(dtype=wp.int64),
    xyz: wp.array(dtype=wp.vec3d),
    at: wp.array(dtype=wp.vec2d),
    apart: wp.array(dtype=wp.vec3d),
    slope: wp.array(dtype=wp.types.vector(6, wp.float64)),
    begin: wp.array(dtype=wp.vec2d),
    R: wp.mat33d,
    t: wp.vec3d,
    lens: wp.vec2d,
    weight: wp.float64,
    huber: wp.float64,
    hessian: wp.array(dtype=wp.mat33d),
    gradient: wp.array(dtype=wp.vec3d),
):
    m = first + wp.tid()
    way = at[m] - begin[m]
    most = wp.float64(0.0)
    fine = wp.isfinite(way[0]) and wp.isfinite(way[1])
    for c in range(3):
        left = apart[m][c] + slope[m][2 * c] * way[0] + slope[m][2 * c + 1] * way[1]
        fine = fine and wp.isfinite(left)
        most = wp.max(most, wp.abs(left))
    if not fine:
        return
    w = weight * wp.min(wp.float64(1.0), huber / wp.max(most, wp.float64(1.0e-9)))
    along, down = _rows(xyz[m], R, t, lens)
    p = int(points[m])
    H = wp.mat33d()
    g = wp.vec3d()
    for c in range(3):
        left = apart[m][c] + slope[m][2 * c] * way[0] + slope[m][2 * c + 1] * way[1]
        row = slope[m][2 * c] * along + slope[m][2 * c + 1] * down
        H += w * wp.outer(row, row)
        g += w * left * row
    hessian[p] += H
    gradient[p] += g
