"""Gaussians in space, and pictures of them (Kerbl et al., 3D Gaussian Splatting for Radiance Fields, 2023).

A Gaussian has a place, an orientation, three scales (standard deviations along its own axes), an opacity and one
colour, the same from everywhere (degree 0 of the spherical harmonics). Its covariance is R S S' R'; in a picture it is
J W R S S' R' W' J', with the pose W and the projection's derivative J at its centre (Zwicker et al., EWA Splatting,
2002), and `BLUR` square pixels more, as in the published program: no Gaussian falls between pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.reconstruct.kernels.splat import FAINT, TILE

BLUR = 0.3  # square pixels
NEAREST = 0.05  # box units from the camera's plane: nearer Gaussians are not drawn
WIDEST = 1.3  # times the picture's half width: beyond, J is taken at its edge, as in the published program


@dataclass(frozen=True)
class Gaussians:
    """Gaussians; lengths are in the box frame.

    Attributes:
        places: Centres.
        quats: Orientation, quaternions w x y z of any length.
        log_scales: Logarithms of the standard deviations along their axes.
        logits: Opacities before the sigmoid.
        colours: RGB.
    """

    places: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logits: Float[Tensor, " N"]
    colours: Float[Tensor, "N 3"]

    def __len__(self) -> int:
        return len(self.places)

    def only(self, which: Bool[Tensor, " N"] | Int[Tensor, " n"]) -> "Gaussians":
        """Some of them."""
        return Gaussians(*(getattr(self, f.name)[which] for f in fields(self)))

    def to(self, device: str) -> "Gaussians":
        """The same on a device."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))

    def at(self, places: Float[Tensor, "N 3"]) -> "Gaussians":
        """The same elsewhere."""
        return replace(self, places=places)

    @property
    def axes(self) -> Float[Tensor, "N 3 3"]:
        """R S: columns are the axes with their standard deviations."""
        return rotations(self.quats) * self.log_scales.exp()[:, None, :]


def transformed(gaussians: Gaussians, matrix: Float[Tensor, "4 4"]) -> Gaussians:
    """The same in another frame, to which a similarity leads."""
    scale = torch.linalg.det(matrix[:3, :3]) ** (1 / 3)
    return replace(
        gaussians,
        places=gaussians.places @ matrix[:3, :3].T + matrix[:3, 3],
        quats=product(quats_of(matrix[None, :3, :3] / scale), gaussians.quats),
        log_scales=gaussians.log_scales + scale.log(),
    )


def product(a: Float[Tensor, "#N 4"], b: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Quaternions w x y z of rotation b followed by a (Hamilton)."""
    aw, ax, ay, az = a.unbind(1)
    bw, bx, by, bz = b.unbind(1)
    parts = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return torch.stack(parts, dim=1)


def rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions w x y z of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


def quats_of(R: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """Unit quaternions w x y z of rotation matrices (Bar-Itzhack 2000: the largest eigenvector of a 4 x 4 matrix)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(1) for row in R.unbind(1))
    rows = (
        a + e + i, h - f, c - g, d - b,
        h - f, a - e - i, b + d, c + g,
        c - g, b + d, e - a - i, f + h,
        d - b, c + g, f + h, i - a - e,
    )  # fmt: skip
    return torch.linalg.eigh(torch.stack(rows, dim=1).reshape(-1, 4, 4))[1][:, :, 3]


def flattened(
    gaussians: Gaussians, camera: Camera
) -> tuple[Float[Tensor, "N 9"], Float[Tensor, " N"], Float[Tensor, "N 2"]]:
    """Gaussians in a picture as `splat` takes them, their depths, and their variances along u and v."""
    pose = gaussians.places.new_tensor(camera.cam_from_world)
    W, t = pose[:, :3], pose[:, 3]
    fx, fy, cx, cy = (float(camera.K[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, depth = (gaussians.places @ W.T + t).unbind(1)
    z = depth.clamp(min=NEAREST)
    limit_x, limit_y = WIDEST * camera.width / 2 / fx, WIDEST * camera.height / 2 / fy
    across, down = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    seen = W @ gaussians.axes  # axes in the camera's frame
    u = (fx * (seen[:, 0] - across[:, None] * seen[:, 2])) / z[:, None]
    v = (fy * (seen[:, 1] - down[:, None] * seen[:, 2])) / z[:, None]
    uu, uv, vv = (u * u).sum(1) + BLUR, (u * v).sum(1), (v * v).sum(1) + BLUR
    size = uu * vv - uv * uv
    place = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)
    conic = torch.stack([vv / size, -uv / size, uu / size], dim=1)
    opacity = gaussians.logits.sigmoid()[:, None]
    flat = torch.cat([place, conic, opacity, gaussians.colours], dim=1)
    return flat, depth, torch.stack([uu, vv], dim=1)


def tiles_of(
    flat: Float[Tensor, "N 9"],
    depth: Float[Tensor, " N"],
    spread: Float[Tensor, "N 2"],
    size: tuple[int, int],
) -> tuple[Int[Tensor, " tiles_and_one"], Int[Tensor, " M"]]:
    """Which Gaussians reach each tile of a picture of (width, height), near to far; as `splat` takes them."""
    across, down = (-(-side // TILE) for side in size)
    reach = (2 * torch.log((flat[:, 5] / FAINT).clamp(min=1)))[:, None].sqrt() * spread.sqrt()
    last = torch.tensor([across - 1, down - 1], device=flat.device)
    lo = ((flat[:, :2] - reach) / TILE).floor().clamp(min=0)
    hi = torch.minimum(((flat[:, :2] + reach) / TILE).floor(), last)
    seen = (depth > NEAREST) & (hi >= lo).all(1) & (flat[:, 5] > FAINT)
    order = seen.nonzero()[:, 0]
    order = order[depth[order].argsort()]
    lo, extent = lo[order].long(), (hi[order] - lo[order]).long() + 1
    count = extent.prod(1)
    which = torch.repeat_interleave(torch.arange(len(order), device=flat.device), count)
    inside = torch.arange(len(which), device=flat.device) - (count.cumsum(0) - count)[which]
    tile = (lo[which, 1] + inside // extent[which, 0]) * across + lo[which, 0] + inside % extent[which, 0]
    tile, by_tile = tile.sort(stable=True)
    edges = torch.arange(across * down + 1, device=flat.device)
    return torch.searchsorted(tile, edges), order[which[by_tile]].int()


def pixel_sizes(places: Float[Tensor, "N 3"], cameras: Sequence[Camera]) -> Float[Tensor, " N"]:
    """How large a pixel is at each place, box units, of the camera that shows it largest; 0 where none does."""
    smallest = places.new_full((len(places),), torch.inf)
    for camera in cameras:
        pose = places.new_tensor(camera.cam_from_world)
        seen = places @ pose[:, :3].T + pose[:, 3]
        pixels = seen @ places.new_tensor(camera.K).T
        size = pixels.new_tensor([camera.width, camera.height])
        inside = ((pixels[:, :2] >= 0) & (pixels[:, :2] <= size * seen[:, 2:])).all(1) & (
            seen[:, 2] > NEAREST
        )
        smallest = torch.where(inside, torch.minimum(smallest, seen[:, 2] / camera.K[0, 0]), smallest)
    return torch.where(smallest.isfinite(), smallest, 0.0)
