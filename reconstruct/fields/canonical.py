"""The scene at rest: density and colour features on voxel grids, a shallow MLP behind them (DeVRF 3.1).

alpha = 1 - (1 + exp(d + b))^(-interval), d interpolated first (DirectVoxGO, Eqs. 6-8): b is set so that d = 0
is `alpha_init`. Colour = MLP(features, encoded view direction). What is empty is an explicit occupancy, rebuilt
from the density as it is; nothing is ever removed for good.
"""

import copy
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from devrf.reconstruct.fields.grids import grid_shape, grown, upsample, voxel_size
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.kernels.march import Volume
from devrf.reconstruct.kernels.occupancy import distance
from devrf.reconstruct.kernels.trilinear import trilinear
from devrf.reconstruct.options import STEP_AT_REST, CanonicalOptions

NUMBERS = ("base_voxel", "stepsize", "shift", "alpha_threshold", "weight_threshold")  # of a `Canonical`
VIEW_FREQUENCIES = 4  # sin and cos at 2^0 .. 2^3 of each component
PUBLISHED_PLANES = 256  # multi-plane densities are per this part of the depth (DirectVoxGO)
OPAQUE = 10.0  # raw density of the last plane: every ray ends there
EMPTY = -10.0  # raw density of space taken to be empty: invisible, but Adam can still raise it


def shift_for(alpha_init: float) -> float:
    """b such that a raw density of 0 has opacity `alpha_init` over one base voxel."""
    return math.log(1 / (1 - alpha_init) - 1)


def even_planes(planes: int) -> Float[Tensor, " planes"]:
    """Raw densities with which a ray is equally likely to stop at each of `planes` planes; the last is opaque.

    Of the rays that reach plane i of N, one in N - i stops there (DirectVoxGO's start for multi-plane images).
    """
    per_plane = PUBLISHED_PLANES / (planes - 1)
    stops = 1 / (planes - torch.arange(planes - 1, dtype=torch.float64))
    optical = -torch.log1p(-stops) / per_plane
    raw = torch.log(torch.expm1(optical))  # the softplus undone
    return torch.cat([raw, torch.tensor([OPAQUE], dtype=torch.float64)]).float()


class ColourNet(nn.Module):
    """Features and view direction to colour: two hidden layers.

    The first layer is split: its part for the view direction is computed once per ray, not per sample.
    """

    def __init__(self, channels: int, width: int, frequencies: int = VIEW_FREQUENCIES) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.features = nn.Linear(channels, width)
        self.view = nn.Linear(3 + 6 * frequencies, width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.out = nn.Linear(width, 3)
        nn.init.zeros_(self.out.bias)

    def forward(
        self, features: Float[Tensor, "S C"], rays_d: Float[Tensor, "R 3"], ray_id: Int[Tensor, " S"]
    ) -> Float[Tensor, "S 3"]:
        """Colours in [0, 1] of samples on rays of unit direction."""
        view = self.view(encode(rays_d, self.frequencies)).index_select(0, ray_id)
        hidden = F.relu(self.hidden(F.relu(self.features(features) + view)))
        return torch.sigmoid(self.out(hidden))


class PlainColour(nn.Module):
    """Three features as a colour, the same from everywhere: for a first, coarse model."""

    def forward(
        self, features: Float[Tensor, "S 3"], rays_d: Float[Tensor, "R 3"], ray_id: Int[Tensor, " S"]
    ) -> Float[Tensor, "S 3"]:
        """Colours in [0, 1]."""
        return torch.sigmoid(features)


def encode(d: Float[Tensor, "R 3"], frequencies: int) -> Float[Tensor, "R C"]:
    """Directions with sines and cosines of their multiples (Mildenhall et al. 2020, Eq. 4)."""
    multiples = (d[..., None] * 2.0 ** torch.arange(frequencies, device=d.device)).flatten(-2)
    return torch.cat([d, multiples.sin(), multiples.cos()], dim=-1)


@dataclass(eq=False, repr=False)
class Canonical:
    """Density, features, MLP and occupancy of the scene at rest.

    Attributes:
        aabb: Box of the grids [2, 3], on the CPU.
        density: Raw density [X, Y, Z, 1].
        features: Colour features [X, Y, Z, C].
        net: The MLP.
        base_voxel: Voxel of the final resolution; densities are per this length.
        stepsize: Step along rays, in voxels.
        shift: b, by which a raw density of 0 is translucent.
        alpha_threshold, weight_threshold: Samples at or below are dropped.
        deferred: Colours are found per ray, from the mean of its samples' features, instead of per sample.
        ndc: Where given, the grids fill a frustum (multi-plane images, as DirectVoxGO has them) instead of a box:
            positions are normalised device coordinates, z of the grids counts planes, and steps go along z.
        distance: Vertices to the nearest occupied vertex [X, Y, Z].
    """

    aabb: Float[Tensor, "2 3"]
    density: Float[Tensor, "X Y Z 1"]
    features: Float[Tensor, "X Y Z C"]
    net: ColourNet | PlainColour
    base_voxel: float
    stepsize: float
    shift: float
    alpha_threshold: float
    weight_threshold: float
    deferred: bool = False
    ndc: Ndc | None = None

    def __post_init__(self) -> None:
        self.aabb = self.aabb.cpu().float()
        self.distance = distance(torch.ones(self.shape, dtype=torch.bool, device=self.density.device))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Vertices along each axis."""
        x, y, z = self.density.shape[:3]
        return x, y, z

    @property
    def resolution(self) -> float:
        """R: the cube root of the number of vertices."""
        return math.prod(self.shape) ** (1 / 3)

    @property
    def voxel(self) -> float:
        """Side of a voxel, in the units of the box: the geometric mean over the axes."""
        return voxel_size(self.aabb, self.shape)

    @property
    def step(self) -> float:
        """Step along rays, in the units of the box; along z where planes are stepped through."""
        if self.ndc is not None:
            return self.stepsize * float(self.aabb[1, 2] - self.aabb[0, 2]) / (self.shape[2] - 1)
        return self.stepsize * self.voxel

    @property
    def interval(self) -> float:
        """The same in base voxels: the exponent of the opacity."""
        return self.step / self.base_voxel

    def volume(self) -> Volume:
        """What the march needs to know."""
        return Volume(
            self.density[..., 0],
            self.distance,
            self.aabb,
            self.shift,
            self.interval,
            self.step,
            self.alpha_threshold,
            self.weight_threshold,
        )

    def alpha(
        self, x: Float[Tensor, "S 3"], density_grad: Float[Tensor, "X Y Z 1"] | None = None
    ) -> Float[Tensor, " S"]:
        """Opacity of one step at points in the box."""
        raw = trilinear(self.density, x, self.aabb, density_grad)[:, 0]
        return 1 - torch.exp(-self.interval * F.softplus(raw + self.shift))

    def features_at(
        self, x: Float[Tensor, "S 3"], features_grad: Float[Tensor, "X Y Z C"] | None = None
    ) -> Float[Tensor, "S C"]:
        """Colour features at points in the box."""
        return trilinear(self.features, x, self.aabb, features_grad)

    def only(self, kept: Bool[Tensor, "X Y Z"]) -> "Canonical":
        """The same scene with some vertices alone, empty elsewhere; its colours are not copied."""
        other = copy.copy(self)
        other.density = torch.where(kept[..., None], self.density, EMPTY)
        other.rebuild_occupancy()
        return other

    def rebuild_occupancy(self, within: Bool[Tensor, "X Y Z"] | None = None) -> Bool[Tensor, "X Y Z"]:
        """Look again at what is empty; returns the vertices that samples can touch."""
        occupied = occupied_in(self)
        if within is not None:
            occupied &= within
        self.distance = distance(occupied)
        return self.reachable()

    def reachable(self) -> Bool[Tensor, "X Y Z"]:
        """Vertices that samples can touch."""
        return grown(self.distance == 0)


def new_canonical(
    aabb: Float[Tensor, "2 3"],
    resolution: float | int,
    options: CanonicalOptions,
    alpha_init: float,
    device: str,
    ndc: Ndc | None = None,
) -> Canonical:
    """A model that knows nothing yet: equally translucent everywhere, or its planes equally likely to stop a ray.

    Without hidden layers (`options.mlp_width` 0) features are colours.
    """
    shape = grid_shape(aabb, resolution, None if ndc is None else options.planes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        net = PlainColour()
        if options.mlp_width:
            frequencies = VIEW_FREQUENCIES if ndc is None else 0
            net = ColourNet(options.channels, options.mlp_width, frequencies).to(device)
    if ndc is None:
        base_voxel, shift = voxel_size(aabb, grid_shape(aabb, options.resolution)), shift_for(alpha_init)
    else:
        base_voxel, shift = float(aabb[1, 2] - aabb[0, 2]) / PUBLISHED_PLANES, 0.0
    density, features = (torch.zeros(*shape, n, device=device) for n in (1, options.channels))
    thresholds = options.alpha_threshold, options.weight_threshold
    model = Canonical(
        aabb, density, features, net, base_voxel, STEP_AT_REST, shift, *thresholds, options.deferred, ndc
    )
    if ndc is not None:
        model.density += even_planes(shape[2]).to(device)[:, None]
    return model


def refine(canonical: Canonical, resolution: float | int) -> None:
    """Interpolate both grids onto more vertices; `rebuild_occupancy` has to follow."""
    shape = grid_shape(canonical.aabb, resolution, None if canonical.ndc is None else canonical.shape[2])
    canonical.density, canonical.features = (
        upsample(canonical.density, shape),
        upsample(canonical.features, shape),
    )


def occupied_in(canonical: Canonical) -> Bool[Tensor, "X Y Z"]:
    """Vertices next to which a sample can be opaque enough to count."""
    alpha = 1 - torch.exp(-canonical.interval * F.softplus(canonical.density[..., 0] + canonical.shift))
    return grown(alpha > canonical.alpha_threshold)


def raw_density(canonical: Canonical, optical: float) -> float:
    """The raw density by which a step has an optical depth."""
    return math.log(math.expm1(optical / canonical.interval)) - canonical.shift


def seen_with(
    canonical: Canonical, stepsize: float, alpha_threshold: float, weight_threshold: float
) -> Canonical:
    """The same scene, not copied, looked at in other steps and with other thresholds."""
    other = copy.copy(canonical)
    other.stepsize = stepsize
    other.alpha_threshold, other.weight_threshold = alpha_threshold, weight_threshold
    return other
