"""The static surroundings of the scene box, so that a real room needs no mattes.

One grid of density and colour over space contracted to a cube (kernels/background.py). Colours do not depend on
the viewing direction: walls and furniture are behind the subject, and a third as many numbers buy resolution
instead. Trained together with the scene at rest, then frozen. The inside of the cube's middle is the box's and
stays empty here.
"""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.reconstruct.fields.canonical import EMPTY, shift_for
from devrf.reconstruct.fields.grids import grown, upsample, vertices
from devrf.reconstruct.kernels.background import Contraction, Surroundings, background
from devrf.reconstruct.kernels.march import RaySegments
from devrf.reconstruct.kernels.occupancy import distance

REACH = 6.0  # the least: a room around its subject
CUBE = torch.tensor([[-2.0] * 3, [2.0] * 3])
ALPHA_INIT = 1e-3  # a ray takes about a hundred steps: enough to start from, little enough to see through
SURFACE = 4.0  # raw density where a surface is known to be: fifty times as opaque as unknown space
STEPSIZE = 1.0  # at the box's surface, in units of a voxel inside it: about half a voxel outside
ALPHA_THRESHOLD = 1e-2  # below, a vertex counts as empty
ALPHA_THRESHOLD_INSIDE = 1e-3  # while nothing is known, everything is


def grey(size: int, device: str = "cpu") -> Float[Tensor, "N N N 4"]:
    """A grid of translucent grey surroundings."""
    return torch.zeros(size, size, size, 4, device=device)


@dataclass(eq=False, repr=False)
class Shell:
    """Surroundings.

    Attributes:
        aabb: The box in the middle [2, 3], on the CPU.
        grid: Raw density and colour [N, N, N, 4].
        final: N at the end of training; densities are per voxel of that size.
        near: Where rays start.
        contraction: Of space to the grid's cube; what is beyond its reach lies on the faces, where rays end.
        inside: The box's inside is modelled here, too (for a first, coarse model of everything).
        points: Points of the scene, by which cameras have near planes of their own (`near_plane.py`); on the CPU.
        distance: Vertices to the nearest occupied vertex [N, N, N].
    """

    aabb: Float[Tensor, "2 3"]
    grid: Float[Tensor, "N N N 4"]
    final: int
    near: float
    contraction: Contraction = Contraction(REACH)
    inside: bool = False
    points: Float[Tensor, "n 3"] = field(default_factory=lambda: torch.zeros(0, 3))

    def __post_init__(self) -> None:
        self.aabb = self.aabb.cpu().float()
        self.points = self.points.cpu().float()
        self.distance = torch.zeros(self.grid.shape[:3], dtype=torch.uint8, device=self.grid.device)

    def begun(self) -> "Shell":
        """The same, empty in the box unless `inside`; of a `grey` grid nothing is known yet."""
        self.clear_inside()
        self.rebuild_occupancy()
        return self

    @property
    def size(self) -> int:
        """Vertices along each axis."""
        return self.grid.shape[0]

    @property
    def interval(self) -> float:
        """Length of a step in voxels of the final size: the exponent of the opacity."""
        return STEPSIZE * (self.final - 1) / (self.size - 1)

    @property
    def alpha_threshold(self) -> float:
        """Opacity of a step below which a vertex counts as empty."""
        return ALPHA_THRESHOLD_INSIDE if self.inside else ALPHA_THRESHOLD

    def surroundings(self) -> Surroundings:
        """What the renderer needs to know."""
        step = STEPSIZE * 4 / (self.size - 1)
        shift = shift_for(ALPHA_INIT)
        return Surroundings(
            self.grid,
            self.distance,
            self.aabb,
            shift,
            self.interval,
            step,
            self.alpha_threshold / 10,
            self.contraction,
        )

    def render(
        self,
        rays: RaySegments,
        closed: bool,
        target: Float[Tensor, "R 3"] | None = None,
        grid_grad: Float[Tensor, "P N N N 4"] | None = None,
        seen: Float[Tensor, "N N N"] | None = None,
    ) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, " R"]]:
        """Colour, transmittance left and per-point loss of segments outside the box."""
        return background(rays, self.surroundings(), closed, target, grid_grad, seen)

    def clear_inside(self) -> None:
        """Empty what the box holds; space near a camera may be filled: others see what stands there."""
        if not self.inside:
            r = vertices(CUBE, (self.size, self.size, self.size)).to(self.grid).abs().amax(-1)
            self.grid[..., 0][r < 1 - 2 * 4 / (self.size - 1)] = EMPTY

    def start_from(self, free: Bool[Tensor, "N N N"], surface: Bool[Tensor, "N N N"]) -> None:
        """Take over what is known of empty space and of surfaces; `rebuild_occupancy` has to follow."""
        density, device = self.grid[..., 0], self.grid.device
        density[surface.to(device) & (density > EMPTY)] = SURFACE
        density[free.to(device)] = EMPTY

    def rebuild_occupancy(self) -> Bool[Tensor, "N N N"]:
        """Look again at what is empty; returns the vertices that samples can touch."""
        alpha = 1 - torch.exp(-self.interval * F.softplus(self.grid[..., 0] + shift_for(ALPHA_INIT)))
        away = distance(alpha > self.alpha_threshold)
        self.distance = away - (away > 0).to(torch.uint8)  # neighbours count as occupied: samples blend them
        return self.reachable()

    def reachable(self) -> Bool[Tensor, "N N N"]:
        """Vertices that samples can touch."""
        reachable = grown(self.distance == 0)
        for axis in range(3):  # rays that hit nothing end on the cube's faces
            reachable.narrow(axis, 0, 2).fill_(True)
            reachable.narrow(axis, self.size - 2, 2).fill_(True)
        return reachable

    def refine(self, size: int) -> None:
        """Interpolate onto more vertices; `rebuild_occupancy` has to follow."""
        self.grid = upsample(self.grid, (size, size, size))
        self.clear_inside()
