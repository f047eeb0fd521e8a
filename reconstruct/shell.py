"""The static surroundings of the scene box, so that a real room needs no mattes.

One grid of density and colour over space contracted to a cube (kernels/background.py). Colours do not depend on
the viewing direction: walls and furniture are behind the subject, and a third as many numbers buy resolution
instead. Trained together with the scene at rest, then frozen. The inside of the cube's middle is the box's and
stays empty here; so does space nearer to a camera than `near`, where nothing could have been photographed.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.reconstruct.canonical import EMPTY, shift_for
from devrf.reconstruct.grids import grown, upsample, vertices
from devrf.reconstruct.kernels.background import Surroundings, background, expand
from devrf.reconstruct.kernels.march import RaySegments

CUBE = torch.tensor([[-2.0] * 3, [2.0] * 3])
ALPHA_INIT = 1e-3  # a ray takes about a hundred steps: enough to start from, little enough to see through
STEPSIZE = 1.0  # at the box's surface, in units of a voxel inside it: about half a voxel outside
ALPHA_THRESHOLD = 1e-3
BLOCK = 1 << 17  # vertices whose distances to all cameras are computed at once


class Shell:
    """Surroundings.

    Attributes:
        aabb: The box in the middle [2, 3], on the CPU.
        grid: Raw density and colour [N, N, N, 4].
        empty: 0 where a vertex is occupied, else 1 [N, N, N].
        final: N at the end of training; densities are per voxel of that size.
        near, far: Where rays start and where they have left all content behind.
        inside: The box's inside is modelled here, too (for a first, coarse model of everything).
    """

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        grid: Float[Tensor, "N N N 4"],
        *,
        final: int,
        near: float,
        far: float,
        inside: bool = False,
    ) -> None:
        self.aabb, self.grid, self.final = aabb.cpu().float(), grid, final
        self.near, self.far, self.inside = near, far, inside
        self.empty = torch.zeros(grid.shape[:3], dtype=torch.uint8, device=grid.device)

    @staticmethod
    def new(
        aabb: Float[Tensor, "2 3"],
        size: int,
        final: int,
        *,
        near: float,
        far: float,
        centres: Float[Tensor, "F 3"],
        device: str,
        inside: bool = False,
    ) -> "Shell":
        """Translucent grey surroundings, empty around camera centres and, unless `inside`, in the box."""
        grid = torch.zeros(size, size, size, 4, device=device)
        shell = Shell(aabb, grid, final=final, near=near, far=far, inside=inside)
        shell.clear_around(centres)
        shell.rebuild_occupancy()
        return shell

    @property
    def size(self) -> int:
        """Vertices along each axis."""
        return self.grid.shape[0]

    def surroundings(self) -> Surroundings:
        """What the renderer needs to know."""
        interval = STEPSIZE * (self.final - 1) / (self.size - 1)
        step = STEPSIZE * 4 / (self.size - 1)
        shift = shift_for(ALPHA_INIT)
        return Surroundings(self.grid, self.empty, self.aabb, shift, interval, step, ALPHA_THRESHOLD / 10)

    def render(
        self,
        rays: RaySegments,
        closed: bool,
        target: Float[Tensor, "R 3"] | None = None,
        grid_grad: Float[Tensor, "N N N 4"] | None = None,
        seen: Float[Tensor, "N N N"] | None = None,
    ) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, " R"]]:
        """Colour, transmittance left and per-point loss of segments outside the box."""
        return background(rays, self.surroundings(), closed, target, grid_grad, seen)

    def clear_around(self, centres: Float[Tensor, "F 3"]) -> None:
        """Empty the box's inside and everything nearer than `near` to a camera."""
        y = vertices(CUBE, (self.size, self.size, self.size)).to(self.grid)
        r = y.abs().amax(-1)
        inside = (r < 1 - 2 * 4 / (self.size - 1)) & (not self.inside)
        lo, hi = self.aabb.to(self.grid)
        x = (expand(y) * (hi - lo) / 2 + (lo + hi) / 2).reshape(-1, 3)
        centres = centres.to(x)
        around = ((x > centres.amin(0) - self.near) & (x < centres.amax(0) + self.near)).all(-1)
        blocked = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        for part in around.nonzero()[:, 0].split(BLOCK):
            blocked[part] = torch.cdist(x[part], centres).amin(-1) < self.near
        self.grid[..., 0][inside | blocked.reshape(r.shape)] = EMPTY

    def rebuild_occupancy(self) -> Bool[Tensor, "N N N"]:
        """Look again at what is empty; returns the vertices that samples can touch."""
        s = self.surroundings()
        alpha = 1 - torch.exp(-s.interval * F.softplus(self.grid[..., 0] + s.shift))
        occupied = grown(alpha > ALPHA_THRESHOLD)
        self.empty = (~occupied).to(torch.uint8)
        reachable = grown(occupied)
        for axis in range(3):  # rays that hit nothing end on the cube's faces
            reachable.narrow(axis, 0, 2).fill_(True)
            reachable.narrow(axis, self.size - 2, 2).fill_(True)
        return reachable

    def refine(self, size: int, centres: Float[Tensor, "F 3"]) -> None:
        """Interpolate onto more vertices."""
        self.grid = upsample(self.grid, (size, size, size))
        self.clear_around(centres)
        self.rebuild_occupancy()
