"""March, interpolate, composite: colours of rays through the scene at rest or in motion, and whole pictures.

A ray's colour is put together from three parts: the surroundings before the box, the box, the surroundings
behind it (or the plain background). Only the box moves. The MLP is asked for every sample, as published, or once
per ray for the mean of its samples' features ("deferred": Hedman et al., Baking Neural Radiance Fields, ICCV
2021), which costs a fraction.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.scene import plain_colour
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.contracted_background import Shell
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.kernels.composite import accumulate, composite_weights
from devrf.reconstruct.kernels.march import RaySegments, Samples, intersect, march
from devrf.reconstruct.rendering.rays import Rays

FAINT = 1e-4  # opacity of a ray below which its mean features no longer grow
BEYOND = 1e9  # everything: a segment that begins there has no samples
SEEN = 1e-3  # transmittance below which what is behind is not looked at


def plain_of(background: str, device: str | torch.device) -> Float[Tensor, " 3"] | None:
    """The plain colour behind the subject; None where surroundings are modelled."""
    colour = plain_colour(background)
    return None if colour is None else torch.tensor(colour, dtype=torch.float32, device=device)


Grads = tuple[Tensor | None, Tensor | None, Tensor | None]
"""Buffers that density, features and surroundings add their gradient to."""


@dataclass
class Rendered:
    """Colours of rays, and what the losses need.

    Attributes:
        rgb: Composited colours.
        left: Transmittance of the box.
        depth: Mean distance of what is seen in the box, weighted; 0 where nothing is.
        weights, colours, ray_id: Of the samples in the box; no colours where they are deferred.
        shell_per_point: Per-point loss of the surroundings, per ray.
    """

    rgb: Float[Tensor, "R 3"]
    left: Float[Tensor, " R"]
    depth: Float[Tensor, " R"]
    weights: Float[Tensor, " S"]
    colours: Float[Tensor, "S 3"] | None
    ray_id: Int[Tensor, " S"]
    shell_per_point: Float[Tensor, " R"]


class RayColours(NamedTuple):
    """What rays see in the box: its colour, the light that it lets through, weighted distance."""

    rgb: Float[Tensor, "R 3"]
    left: Float[Tensor, " R"]
    depth: Float[Tensor, " R"]


def render_rest(
    canonical: Canonical,
    behind: Shell | Float[Tensor, " 3"] | None,
    rays: Rays,
    target: Float[Tensor, "R 3"] | None = None,
    grads: Grads = (None, None, None),
) -> Rendered:
    """Colours of rays through the scene at rest, before its surroundings, a plain colour or nothing; differentiable.

    The `jitter` of rays is [2, R].
    """
    segments = segments_in(canonical.aabb, canonical.ndc, rays.o, rays.d, rays.near, rays.jitter[0])
    samples = march(segments, canonical.volume())
    x = points_on(segments, samples)
    weights, left = composite_weights(canonical.alpha(x, grads[0]), samples.offsets)
    away = distances(x, samples, canonical.ndc, rays.o)
    rgb, depth, colours = shade(canonical, x, rays.d, samples, (weights, away), grads[1])
    per_point = torch.zeros_like(left)
    if isinstance(behind, Shell):
        ends = segments.t_in, segments.t_out
        rgb, per_point = _with_surroundings(behind, rays, ends, (rgb, left), target, grads[2])
    elif behind is not None:
        rgb = rgb + left[:, None] * behind
    return Rendered(rgb, left, depth, weights, colours, samples.ray_id, per_point)


def shade(
    canonical: Canonical,
    x: Float[Tensor, "S 3"],
    rays_d: Float[Tensor, "R 3"],
    samples: Samples,
    seen: tuple[Float[Tensor, " S"], Float[Tensor, " S"]],
    features_grad: Float[Tensor, "X Y Z C"] | None = None,
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, "S 3"] | None]:
    """Colours of the box along rays, weighted distances, and the samples' own colours (None where deferred).

    Args:
        canonical: The scene at rest.
        x: Samples at rest.
        rays_d: Directions of the rays.
        samples: Which ray each sample is on.
        seen: Of the samples: how much each is seen, and from how far.
        features_grad: Where the gradient of the features is added.
    """
    weights, away = seen
    if not canonical.deferred:
        colours = canonical.net(canonical.features_at(x, features_grad), rays_d, samples.ray_id)
        sums = accumulate(weights, torch.cat([colours, away[:, None]], dim=1), samples.ray_id, len(rays_d))
        return sums[:, :3], sums[:, 3].detach(), colours
    hit = (samples.offsets[1:] > samples.offsets[:-1]).nonzero()[:, 0]
    of_hit = torch.zeros(len(rays_d), dtype=torch.int64, device=hit.device)
    of_hit[hit] = torch.arange(len(hit), device=hit.device)
    features = canonical.features_at(x, features_grad)
    values = torch.cat([features, torch.ones_like(away)[:, None], away[:, None]], dim=1)
    sums = accumulate(weights, values, of_hit[samples.ray_id], len(hit))
    opacity = sums[:, -2:-1]
    colours = opacity * canonical.net(sums[:, :-2] / opacity.clamp_min(FAINT), rays_d[hit], of_hit[hit])
    rgb = torch.zeros_like(rays_d).index_copy(0, hit, colours)
    return rgb, torch.zeros_like(rays_d[:, 0]).index_copy(0, hit, sums[:, -1].detach()), None


def segments_in(
    aabb: Float[Tensor, "2 3"],
    ndc: Ndc | None,
    rays_o: Float[Tensor, "R 3"],
    rays_d: Float[Tensor, "R 3"],
    near: float,
    jitter: Float[Tensor, " R"],
) -> RaySegments:
    """The parts of rays in a model's box, in the coordinates of its grids."""
    if ndc is not None:
        rays_o, rays_d = ndc.rays(rays_o, rays_d)
        near = 0.0
    t_in, t_out, _ = intersect(rays_o, rays_d, aabb, near)
    return RaySegments(rays_o, rays_d, t_in, t_out, jitter)


def points_on(segments: RaySegments, samples: Samples) -> Float[Tensor, "S 3"]:
    """Positions of samples, in the coordinates of the grids."""
    return segments.rays_o[samples.ray_id] + samples.t[:, None] * segments.rays_d[samples.ray_id]


def distances(
    x: Float[Tensor, "S 3"], samples: Samples, ndc: Ndc | None, rays_o: Float[Tensor, "R 3"]
) -> Float[Tensor, " S"]:
    """Distances of samples from their rays' origins, in the box frame."""
    if ndc is None:
        return samples.t
    return (ndc.to_world(x.detach()) - rays_o[samples.ray_id]).norm(dim=1)


def _with_surroundings(
    shell: Shell,
    rays: Rays,
    ends: tuple[Tensor, Tensor],
    box: tuple[Tensor, Tensor],
    target: Tensor | None,
    grid_grad: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Put the surroundings before and behind what the box shows and lets through; also their per-point loss."""
    (t_in, t_out), (rgb, left) = ends, box
    before = RaySegments(rays.o, rays.d, torch.full_like(t_in, rays.near), t_in, rays.jitter[1])
    front, through, apart = shell.render(before, False, target, grid_grad)
    hidden = (through * left).detach() < SEEN
    begin = torch.where(hidden, BEYOND, t_out)
    behind = RaySegments(rays.o, rays.d, begin, begin, rays.jitter[1])
    back, _, apart_behind = shell.render(behind, True, target, grid_grad)
    rgb = front + through[:, None] * (rgb + left[:, None] * back)
    return rgb, apart + (through * left).detach() * apart_behind
