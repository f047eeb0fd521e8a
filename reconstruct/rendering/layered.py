"""Rays through what stands and what moves: all samples are sorted along the ray and composited once."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.movers import Movers, Placed
from devrf.reconstruct.kernels.composite import accumulate, composite_weights
from devrf.reconstruct.kernels.composite_layers import Drawn, Fields, composite_layers
from devrf.reconstruct.kernels.launch import use_warp
from devrf.reconstruct.kernels.layers import march_layers
from devrf.reconstruct.rendering.rays import Rays
from devrf.reconstruct.rendering.render import FAINT, RayColours

COUNTS = 1e-3  # weight from which a sample has a colour


class Layered(NamedTuple):
    """Rays through what stands and what moves, and what the losses need.

    Attributes:
        rgb: Colour of the box alone.
        left: Transmittance of the box.
        depth: Weighted distance of what is seen in the box.
        weights, colours, ray_id: Of the samples that have a colour; no colours where they are deferred.
    """

    rgb: Float[Tensor, "R 3"]
    left: Float[Tensor, " R"]
    depth: Float[Tensor, " R"]
    weights: Float[Tensor, " S"]
    colours: Float[Tensor, "S 3"] | None
    ray_id: Int[Tensor, " S"]


def render_layered(
    stands: Canonical,
    movers: Movers,
    placed: Placed,
    rays: Rays,
    grads: Fields | None = None,
    counts_from: float = COUNTS,
) -> Layered:
    """Colours of rays through what stands and what moves; differentiable in both, in `placed` and in the shading.

    Args:
        stands: What stands.
        movers: What moves.
        placed: Where it is, in some pictures.
        rays: Each with its picture, among those.
        grads: Where the gradients of the grids are added.
        counts_from: Weight from which a sample has a colour.
    """
    rays_o, rays_d, near, jitter, frame = rays
    assert frame is not None
    if stands.deferred and use_warp(rays_o.device):
        own, light = movers.canonical, movers.shading
        fields = Fields(stands.density, stands.features, own.density, own.features)
        drawn = composite_layers(
            stands.volume(), movers.packed(), placed.turned(frame), fields,
            None if light is None else light.light(placed.times),
            rays_o, rays_d, near, jitter, counts_from, grads,
        )  # fmt: skip
        none = frame.new_zeros(0)
        return Layered(_seen(stands, drawn, rays_d), drawn.left, drawn.depth, drawn.left[:0], None, none)
    into = grads or (None,) * 4
    ray_id, t, part, x, samples_d, offsets = march_layers(
        stands.volume(), movers.packed(), placed.turned(frame), rays_o, rays_d, near, jitter
    )
    if placed.rotations.requires_grad:
        x = _taken_back(x, part, placed, frame[ray_id], rays_o[ray_id] + t[:, None] * rays_d[ray_id])
    still, moved = (part == 0).nonzero()[:, 0], (part > 0).nonzero()[:, 0]
    alpha = torch.zeros_like(t).index_put((still,), stands.alpha(x[still], into[0]))
    alpha = alpha.index_put((moved,), movers.canonical.alpha(x[moved], into[2]))
    weights, left = composite_weights(alpha, offsets)
    with torch.no_grad():
        depth = accumulate(weights, t[:, None], ray_id, len(rays_o))[:, 0]
    counts = (weights.detach() > counts_from).nonzero()[:, 0]
    x, ray_id, t, part, samples_d = (values[counts] for values in (x, ray_id, t, part, samples_d))
    weights = weights[counts]
    still, moved = (part == 0).nonzero()[:, 0], (part > 0).nonzero()[:, 0]
    features = x.new_zeros(len(x), stands.features.shape[3])
    features = features.index_put((still,), stands.features_at(x[still], into[1]))
    features = features.index_put((moved,), movers.canonical.features_at(x[moved], into[3]))
    light = None
    if movers.shading is not None:
        place = rays_o[ray_id] + t[:, None] * rays_d[ray_id]
        place = torch.where((part > 0)[:, None], x, place)
        light = movers.shading.at((part > 0).long(), place, placed.times[frame[ray_id]])
    if stands.deferred:
        rgb, colours = _deferred(stands, features, weights, light, rays_d, ray_id), None
    else:
        colours = stands.net(features, samples_d, torch.arange(len(x), device=x.device))
        if light is not None:
            colours = colours * torch.exp(light)[:, None]
        rgb = accumulate(weights, colours, ray_id, len(rays_o))
    return Layered(rgb, left, depth, weights, colours, ray_id)


@torch.no_grad()
def draw_layered(
    stands: Canonical, movers: Movers, placed: Placed, rays: Rays, counts_from: float = COUNTS
) -> RayColours:
    """The same for pictures, without gradients."""
    seen = render_layered(stands, movers, placed, rays, counts_from=counts_from)
    return RayColours(seen.rgb, seen.left, seen.depth)


def _seen(stands: Canonical, drawn: Drawn, rays_d: Tensor) -> Float[Tensor, "R 3"]:
    """Colours of rays that are composited; in pictures only those that meet something are asked for."""
    sums = drawn.features, drawn.light, drawn.opacity, rays_d
    if torch.is_grad_enabled():
        return _by_mean(stands, *sums)
    hit = (drawn.opacity > 0).nonzero()[:, 0]
    return torch.zeros_like(rays_d).index_copy(0, hit, _by_mean(stands, *(x[hit] for x in sums)))


def _deferred(
    stands: Canonical, features: Tensor, weights: Tensor, light: Tensor | None, rays_d: Tensor, ray_id: Tensor
) -> Tensor:
    """Colours of rays by the mean features of their samples."""
    rays = len(rays_d)
    ones = torch.ones_like(weights)[:, None]
    light = torch.zeros_like(ones) if light is None else light[:, None]
    sums = accumulate(weights, torch.cat([features, light, ones], dim=1), ray_id, rays)
    return _by_mean(stands, sums[:, :-2], sums[:, -2], sums[:, -1], rays_d)


def _by_mean(stands: Canonical, features: Tensor, light: Tensor, opacity: Tensor, rays_d: Tensor) -> Tensor:
    """Colours of rays by sums over their samples: weighted features and light, and weights."""
    seen, every = opacity.clamp_min(FAINT)[:, None], torch.arange(len(rays_d), device=rays_d.device)
    return opacity[:, None] * stands.net(features / seen, rays_d, every) * torch.exp(light[:, None] / seen)


def _taken_back(
    x: Float[Tensor, "s 3"],
    part: Int[Tensor, " s"],
    placed: Placed,
    frame: Int[Tensor, " s"],
    now: Float[Tensor, "s 3"],
) -> Float[Tensor, "s 3"]:
    """Where samples of parts rest, once more by `placed`, so that gradients reach it; the others as they are."""
    moved = (part > 0).nonzero()[:, 0]
    every = torch.cat([placed.back.flatten(2), placed.shifts], dim=2)
    key = frame[moved] * every.shape[1] + part[moved] - 1
    # gather's gradient adds up in the same order each time; that of an index does not.
    mine = every.flatten(0, 1).gather(0, key[:, None].expand(-1, 12))
    rested = torch.einsum("sij,sj->si", mine[:, :9].unflatten(1, (3, 3)), now[moved] - mine[:, 9:])
    return x.index_put((moved,), rested)
