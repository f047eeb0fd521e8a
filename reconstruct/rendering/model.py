"""The whole model, at rest or in motion, and pictures of it.

A ray's colour: surroundings before the box, the box with its contents moved, surroundings behind it (or the plain
background). Surroundings do not move, so a camera that stands still needs them once.
"""

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.carried import field_of
from devrf.reconstruct.fields.grids import grid_shape, voxel_size
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import Movers, Placed
from devrf.reconstruct.kernels.composite import composite_weights
from devrf.reconstruct.kernels.march import RaySegments, Samples, Warp, intersect, march
from devrf.reconstruct.kernels.occupancy import REACH, distance, moved_occupancy
from devrf.reconstruct.kernels.quad import quad
from devrf.reconstruct.options import CHUNK
from devrf.reconstruct.rendering.layered import draw_layered
from devrf.reconstruct.rendering.rays import Rays, camera_rays
from devrf.reconstruct.rendering.render import (
    RayColours,
    Rendered,
    distances,
    plain_of,
    points_on,
    render_rest,
    segments_in,
    shade,
)

FEWEST_AT_ONCE = 1 << 9  # rays, where memory is short: fewer would be slow and need hardly less
CACHED_BYTES = 1 << 28  # of surroundings of cameras that are remembered: 20 cameras of 0.5 megapixels
CACHED_TIMES = 64  # of which it is remembered where the moving scene may be: 64 kB each
QUICK = 2  # in a hurry, surroundings are rendered at so many times smaller sides: a quarter of the time
LIVE_VOXELS = 40  # size of the grid that says where the moving scene may be
STRETCH = 1.5  # how much a motion may stretch space inside one of its cells
FIELD_VOXELS = 4  # of the scene at rest in a cell of the motion of movers, given as a field
SOLID = 0.5  # opacity from which a pixel shows a surface

Layers = tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
"""A rendered picture, its depth (weighted distance in the box, 0 where nothing is) and the box's opacity."""


def _nothing() -> None:
    pass


@dataclass
class Around:
    """What is outside the box along rays: colour before it, light that comes through, colour behind it."""

    front: Float[Tensor, "R 3"]
    through: Float[Tensor, " R"]
    back: Float[Tensor, "R 3"]

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return sum(part.numel() * part.element_size() for part in (self.front, self.through, self.back))

    def compose(self, rgb: Float[Tensor, "R 3"], left: Float[Tensor, " R"]) -> Float[Tensor, "R 3"]:
        """Colours of whole rays from what the box shows and lets through."""
        return self.front + self.through[:, None] * (rgb + left[:, None] * self.back)


@dataclass
class Moved:
    """Rays through the scene in motion, and what the losses need.

    Attributes:
        rgb: Colour of the box alone.
        left: Transmittance of the box.
        depth: Weighted distance of what is seen in the box.
        samples: Where the march looked.
        x, x0: Samples at their own time and at rest.
        weights, colours: Of the samples; no colours where they are deferred.
    """

    rgb: Float[Tensor, "R 3"]
    left: Float[Tensor, " R"]
    depth: Float[Tensor, " R"]
    samples: Samples
    x: Float[Tensor, "S 3"]
    x0: Float[Tensor, "S 3"]
    weights: Float[Tensor, " S"]
    colours: Float[Tensor, "S 3"] | None


@dataclass
class DynamicModel:
    """The scene at rest, how it moves (None: it does not), and the same as it looks in motion (None: the same).

    With `movers` pictures in motion are made of these and of what stands, which is `in_motion` then; `motion` says
    where points go. Pictures are rendered `chunk` rays at a time.
    """

    rest: RestModel
    motion: MotionField | None = None
    in_motion: RestModel | None = None
    movers: Movers | None = None
    chunk: int = CHUNK
    _around: OrderedDict[tuple[object, ...], Around] = field(default_factory=OrderedDict, repr=False)
    _live: OrderedDict[float, Tensor] = field(default_factory=OrderedDict, repr=False)

    @staticmethod
    def of_movers(
        rest: RestModel, stands: RestModel, movers: Movers, keys: int, rest_time: float
    ) -> "DynamicModel":
        """What stands and what moves, and its motion as fields of `keys` key times."""
        motion = field_of(movers, keys, rest_time, rest.canonical.resolution / FIELD_VOXELS)
        return DynamicModel(rest, motion, stands, movers)

    def alone(self, background: str) -> "DynamicModel":
        """What is in the box before a plain colour, without its surroundings; grids are not copied."""
        parts = [self.rest, self.in_motion]
        rest, in_motion = (p and replace(p, shell=None, background=background) for p in parts)
        assert rest is not None
        return DynamicModel(rest, self.motion, in_motion, self.movers, self.chunk)

    def unshaded(self) -> "DynamicModel | None":
        """The same in constant light; None where its light is constant."""
        if self.movers is None or self.movers.shading is None:
            return None
        return replace(self, movers=self.movers.unshaded())

    def showing(self, stands: bool, parts: Collection[int]) -> "DynamicModel":
        """The same in motion with some of its layers alone.

        Args:
            stands: What stands in the box is shown.
            parts: Parts of what moves that are, counted from 1.
        """
        assert self.movers is not None and self.in_motion is not None  # asked of models with movers only
        canonical = self.in_motion.canonical
        if not stands:
            canonical = canonical.only(torch.zeros_like(self.movers.labels, dtype=torch.bool))
        in_motion = replace(self.in_motion, canonical=canonical)
        return DynamicModel(self.rest, self.motion, in_motion, self.movers.only(parts), self.chunk)

    def box_at_rest(self, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"]) -> Rendered:
        """Colours of the box alone, before nothing, and what it lets through."""
        black, middle = torch.zeros(3, device=rays_o.device), rays_o.new_full((2, len(rays_o)), 0.5)
        return render_rest(self.rest.canonical, black, Rays(rays_o, rays_d, self.rest.near, middle))

    def box_at(
        self, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"], times: Float[Tensor, " R"]
    ) -> RayColours:
        """What rays see in the box, each at its own time in [0, 1]; `chunk` at a time."""
        rgb, left, depth = torch.zeros_like(rays_o), torch.ones_like(times), torch.zeros_like(times)
        for part, seen in self._parts_at(rays_o, rays_d, times):
            rgb[part], left[part], depth[part] = seen.rgb, seen.left, seen.depth
        return RayColours(rgb, left, depth)

    def _parts_at(
        self, rays_o: Tensor, rays_d: Tensor, times: Tensor
    ) -> Iterator[tuple[Tensor, RayColours | Moved]]:
        """Numbers of some of the rays, and what they see."""
        if self.movers is not None:
            moments, frame = times.unique(return_inverse=True)
            placed = self.movers.placed(moments)
            for part in torch.arange(len(times), device=times.device).split(self.chunk):
                rays = Rays.middle(rays_o[part], rays_d[part], self.rest.near, frame[part])
                yield part, _layered(self, placed, rays)
            return
        assert self.motion is not None  # asked of models with motion only
        motion, rest = self.motion, self.in_motion or self.rest
        tau = motion.tau(times)
        interval = tau.long().clamp(max=motion.keys - 2)
        for first in interval.unique().tolist():
            window = motion.window(first, first + 1, rays_o.device)
            mine = (interval == first).nonzero()[:, 0]
            live = live_distance(rest, window, (tau[mine] - first).unique(), 1)
            for part in mine.split(self.chunk):
                rays = Rays.middle(rays_o[part], rays_d[part], rest.near)
                at = (tau[part] - first).contiguous()
                yield part, render_moved(rest.canonical, window, live, rays, at)

    def around_camera(self, camera: Camera, between: Callable[[], object] = _nothing) -> Around:
        """Surroundings of all pixels of a camera, row by row; remembered. `between` as `render_layers`'."""
        key = camera.view
        if key not in self._around:
            device = str(self.rest.canonical.density.device)
            parts, near = [], self.rest.near_for(camera)
            for o, d in _chunks(*camera_rays(camera, device), self.chunk):
                between()
                parts.append(self.around(o, d, near))
            self._around[key] = Around(
                *(torch.cat([getattr(p, name) for p in parts]) for name in ("front", "through", "back"))
            )
            while len(self._around) > 1 and sum(a.bytes for a in self._around.values()) > CACHED_BYTES:
                self._around.popitem(last=False)
        return self._around[key]

    def around_roughly(self, camera: Camera, between: Callable[[], object] = _nothing) -> Around:
        """The same of a smaller picture, interpolated; as they are where they are remembered."""
        if camera.view in self._around or self.rest.shell is None:
            return self.around_camera(camera, between)
        small = camera.scaled(1 / QUICK)
        found = self.around_camera(small, between)
        maps = torch.cat([found.front, found.through[:, None], found.back], dim=1)
        maps = maps.T.reshape(1, 7, small.height, small.width)
        whole = F.interpolate(maps, (camera.height, camera.width), mode="bilinear").reshape(7, -1).T
        return Around(whole[:, :3], whole[:, 3], whole[:, 4:])

    def live_at(self, time: float) -> Tensor:
        """Distances to where the scene may be occupied at a time (`live_distance`); remembered."""
        assert self.motion is not None
        if time not in self._live:
            rest = self.in_motion or self.rest
            motion, tau = self.motion.at(time, rest.canonical.density.device)
            self._live[time] = live_distance(rest, motion, tau, 1)
            if len(self._live) > CACHED_TIMES:
                self._live.popitem(last=False)
        return self._live[time]

    def forget(self) -> None:
        """Give back memory that is only held to be quicker."""
        self._around.clear()
        self._live.clear()
        torch.cuda.empty_cache()  # does nothing where there is none

    @torch.no_grad()
    def around(
        self, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"], near: float | None = None
    ) -> Around:
        """Surroundings of rays, from a distance on; None: that of the scene."""
        rest, n = self.rest, len(rays_o)
        near = rest.near if near is None else near
        plain = plain_of(rest.background, rays_o.device)
        if plain is not None:
            return Around(torch.zeros_like(rays_o), rays_o.new_ones(n), plain.expand(n, 3).contiguous())
        assert rest.shell is not None  # surroundings are modelled wherever nothing plain is behind
        t_in, t_out, _ = intersect(rays_o, rays_d, rest.canonical.aabb, near)
        middle = rays_o.new_full((n,), 0.5)
        begin = torch.full_like(t_in, near)
        front, through, _ = rest.shell.render(RaySegments(rays_o, rays_d, begin, t_in, middle), False)
        back, _, _ = rest.shell.render(RaySegments(rays_o, rays_d, t_out, t_out, middle), True)
        return Around(front, through, back)


def moments_of(model: DynamicModel) -> list[float]:
    """Times in [0, 1] at which a motion is stored: moments of movers, or key times; none where nothing moves."""
    if model.movers is not None:
        return model.movers.times.tolist()
    return [] if model.motion is None else model.motion.key_times


def live_distance(rest: RestModel, motion: MotionField, taus: Float[Tensor, " M"], reach: int) -> Tensor:
    """Distances to where the moving scene may be occupied at any of `taus`, over the motion's box.

    Args:
        reach: Voxels of the scene at rest by which the motion may still change.
    """
    shape = grid_shape(motion.aabb, LIVE_VOXELS)
    cell, voxel = voxel_size(motion.aabb, shape), voxel_size(rest.canonical.aabb, rest.canonical.shape)
    coarser = int(np.ceil(0.5 * STRETCH * cell / voxel))  # a vertex of this grid stands for several at rest
    canonical = rest.canonical
    occupied = moved_occupancy(
        shape, motion.aabb, motion.backward, taus, canonical.distance, canonical.aabb,
        min(REACH - 1, reach + coarser),
    )  # fmt: skip
    return distance(occupied)


class MovedGrads(NamedTuple):
    """Buffers that gradients are added to.

    Attributes:
        keys: Of the backward motion, from `first_key` on.
        density, features: Of the scene at rest.
    """

    keys: Float[Tensor, "K X Y Z 3"] | None = None
    first_key: int = 0
    density: Float[Tensor, "X Y Z 1"] | None = None
    features: Float[Tensor, "X Y Z C"] | None = None


NOT_TRAINED = MovedGrads()


def render_moved(
    canonical: Canonical,
    motion: MotionField,
    live: Tensor,
    rays: Rays,
    tau: Float[Tensor, " R"],
    grads: MovedGrads = NOT_TRAINED,
) -> Moved:
    """March through the scene as it is at each ray's own time; differentiable in what `grads` has buffers of."""
    segments = segments_in(motion.aabb, canonical.ndc, *rays[:4])
    samples = march(segments, canonical.volume(), Warp(motion.backward, tau.contiguous(), motion.aabb, live))
    x = points_on(segments, samples)
    x0 = x + quad(motion.backward, x, tau[samples.ray_id], motion.aabb, grads.keys, grads.first_key)
    weights, left = composite_weights(canonical.alpha(x0, grads.density), samples.offsets)
    away = distances(x, samples, canonical.ndc, rays.o)
    rgb, depth, colours = shade(canonical, x0, rays.d, samples, (weights, away), grads.features)
    return Moved(rgb, left, depth, samples, x, x0, weights, colours)


def render_view(
    model: DynamicModel, camera: Camera, time: float | None
) -> Float32[np.ndarray, "height width 3"]:
    """A picture in [0, 1] of a camera in the box frame, at a time in [0, 1]; None: the scene at rest."""
    return render_layers(model, camera, time)[0]


@torch.no_grad()
def render_layers(
    model: DynamicModel,
    camera: Camera,
    time: float | None,
    *,
    between: Callable[[], object] = _nothing,
    roughly: bool = False,
) -> Layers:
    """A picture, its depth (weighted distance in the box, 0 where nothing is) and the box's opacity.

    Where a GPU has no room for the rays, it is tried again with half of them at once, and so from then on.

    Args:
        model: What is rendered.
        camera: In the box frame.
        time: In [0, 1]; None: the scene at rest.
        between: Called before each part of the rays; what it raises ends the picture.
        roughly: Surroundings of new cameras may be softer, for a picture that another one follows at once.
    """
    while True:
        try:
            return _layers(model, camera, time, between, roughly)
        except torch.OutOfMemoryError:
            if model.chunk <= FEWEST_AT_ONCE:
                raise
        model.chunk //= 2  # here the failed try holds nothing any more
        model.forget()


def _layers(
    model: DynamicModel, camera: Camera, time: float | None, between: Callable[[], object], roughly: bool
) -> Layers:
    rest, motion = model.rest, model.motion
    device = str(rest.canonical.density.device)
    rays_o, rays_d = camera_rays(camera, device)
    around = (model.around_roughly if roughly else model.around_camera)(camera, between)
    live = tau = placed = None
    if model.movers is not None and model.in_motion is not None and time is not None:
        placed = model.movers.placed(torch.tensor([time]))
    elif motion is not None and time is not None:
        rest = model.in_motion or rest
        motion, tau = motion.at(time, device)
        live = model.live_at(time)
    out: list[tuple[Tensor, Tensor, Tensor]] = []
    # of movers little is held a ray, whatever its length in the box
    for o, d in _chunks(rays_o, rays_d, model.chunk if placed is None else 2 * model.chunk):
        between()
        if placed is not None:
            frame = torch.zeros(len(o), dtype=torch.int64, device=device)
            seen = _layered(model, placed, Rays.middle(o, d, rest.near, frame))
        elif motion is not None and live is not None and tau is not None:
            at, rays = tau.expand(len(o)).contiguous(), Rays.middle(o, d, rest.near)
            seen = render_moved(rest.canonical, motion, live, rays, at)
        else:
            seen = model.box_at_rest(o, d)
        out.append((seen.rgb, seen.left, seen.depth))
    rgb, left, depth = (torch.cat(parts) for parts in zip(*out, strict=True))
    size = (camera.height, camera.width)
    picture = around.compose(rgb, left).clamp(0, 1).reshape(*size, 3)
    return picture.cpu().numpy(), depth.reshape(size).cpu().numpy(), (1 - left).reshape(size).cpu().numpy()


def _layered(model: DynamicModel, placed: Placed, rays: Rays) -> RayColours:
    """Rays through what stands and what moves, each at the time of its picture."""
    assert model.in_motion is not None and model.movers is not None
    return draw_layered(model.in_motion.canonical, model.movers, placed, rays)


def _chunks(rays_o: Tensor, rays_d: Tensor, size: int) -> list[tuple[Tensor, Tensor]]:
    return list(zip(rays_o.split(size), rays_d.split(size), strict=True))
