# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Composite rays through what stands and all parts that move: mean features in one launch, their gradients in another.

Per ray, over the samples that `layers.marched` found: sums of features and of the logarithm of brightness by weight,
opacity, transmittance. The backward pass goes the same way once more: with `value` what a sample adds to the loss for
one unit of its weight and `behind` what all later samples and the transmittance add, the density of a sample changes
the loss by interval * sigmoid(raw) * (transmittance after it * value - behind).
"""

import functools
from typing import Any, NamedTuple, no_type_check

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.kernels.background import sigmoid
from devrf.reconstruct.kernels.launch import array, box_arguments, launch
from devrf.reconstruct.kernels.layers import (
    Marched,
    PackedVolumes,
    Turned,
    corners_and_scale,
    density_at,
    marched,
    rules_of,
    vec5,
)
from devrf.reconstruct.kernels.march import Volume, alpha_of
from devrf.reconstruct.kernels.trilinear import cell_of, dotted_slope, fraction_in, look_up, scatter, slope_of


class ShadingGrid(NamedTuple):
    """How brightness changes (`shading.py`): its grid and box, and where among its moments each picture is."""

    grid: Float[Tensor, "2 T X Y Z"]
    aabb: Float[Tensor, "2 3"]
    moment: Float[Tensor, " F"]


class Fields(NamedTuple):
    """Density and features of what stands, and of all parts on the same grid; or where their gradients are added."""

    density: Float[Tensor, "X Y Z 1"]
    features: Float[Tensor, "X Y Z C"]
    own_density: Float[Tensor, "X Y Z 1"]
    own_features: Float[Tensor, "X Y Z C"]


class Drawn(NamedTuple):
    """Rays as they are composited.

    Attributes:
        features: Of their samples that count, weighted and added up.
        light: The same of the logarithm of brightness.
        opacity: Sum of the weights that count.
        left: Transmittance.
        depth: Weighted distance.
    """

    features: Float[Tensor, "R C"]
    light: Float[Tensor, " R"]
    opacity: Float[Tensor, " R"]
    left: Float[Tensor, " R"]
    depth: Float[Tensor, " R"]


def composite_layers(
    stands: Volume,
    parts: PackedVolumes,
    turned: Turned,
    fields: Fields,
    light: ShadingGrid | None,
    rays_o: Float[Tensor, "R 3"],
    rays_d: Float[Tensor, "R 3"],
    near: float,
    jitter: Float[Tensor, " R"],
    counts_from: float,
    grads: Fields | None = None,
) -> Drawn:
    """March and composite (Warp only); differentiable in where parts are and in the light, but for the depth.

    Arguments as `march_layers`'s, and:

    Args:
        fields: Of what stands and of all parts.
        light: How brightness changes; None: not at all.
        counts_from: Weight from which a sample is seen.
        grads: Where gradients of the fields are added.
    """
    found = marched(stands, parts, turned, rays_o, rays_d, near, jitter)
    moment, shown = _shown(light, rays_o)
    grid = rays_o.new_zeros(1) if light is None else light.grid
    if grads is not None:
        fields = Fields(*(grid.detach().requires_grad_() for grid in fields))  # so that autograd comes by
    shared = (found, stands, moment, shown, counts_from, grads)
    return Drawn(*_Composited.apply(turned.back, turned.shifts, grid, *fields, shared))  # type: ignore[misc]


class _Composited(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, back: Tensor, shifts: Tensor, light: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        fields, shared = Fields(*rest[:4]), rest[4]
        found: Marched = shared[0]
        R, channels = len(found.counts), fields.features.shape[3]
        vec, forward, *_ = _kernels(channels)
        empty = functools.partial(torch.empty, device=light.device)
        features, (bright, opacity, left, depth) = empty(R, channels), empty(4, R)
        outputs = [array(features, vec), *(array(x) for x in (bright, opacity, left, depth))]
        launch(forward, R, [*_arguments(fields, light, *shared[:5]), *outputs], light.device)
        ctx.save_for_backward(back, shifts, light, features, bright, opacity, left)
        ctx.fields, ctx.shared = fields, shared
        ctx.mark_non_differentiable(depth)
        return features, bright, opacity, left, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Any, ...]:
        back, shifts, light, *sums = ctx.saved_tensors
        fields: Fields = ctx.fields
        found, *_, grads = ctx.shared
        vec, _, of_fields, of_places = _kernels(fields.features.shape[3])
        into = grads if grads is not None else Fields(*(torch.zeros_like(grid) for grid in fields))
        # Not autograd's: by how much the density of each sample counts, and its weight, 0 where it is not seen.
        back_grad, shifts_grad, light_grad = (x.new_zeros(x.shape) for x in (back, shifts, light))
        thicker, weights = torch.empty(2, *found.size, device=light.device)
        shared, R = _arguments(fields, light, *ctx.shared[:5]), len(found.counts)
        by = [array(g.contiguous()) for g in grad_outputs[1:4]]
        features_by, kept = array(grad_outputs[0].contiguous(), vec), [array(thicker), array(weights)]
        arguments = [
            *(*shared, array(sums[0], vec), *(array(x) for x in sums[1:]), features_by, *by, *kept),
            *(array(into.density.reshape(-1)), array(into.features, vec)),
            *(array(into.own_density.reshape(-1)), array(into.own_features, vec)),
        ]
        launch(of_fields, R, arguments, light.device, into=[array(light_grad.reshape(-1))])
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            arguments = [*shared, features_by, by[0], *kept, array(back_grad, wp.mat33)]
            launch(of_places, R, arguments, light.device, into=[array(shifts_grad, wp.vec3)])
        return back_grad, shifts_grad, light_grad, *(into if grads is None else (None,) * 4), None


def _shown(light: ShadingGrid | None, like: Tensor) -> tuple[Tensor, list[Any]]:
    """Moments of pictures, and what kernels need to know of the grid of brightness."""
    if light is None:
        return like.new_zeros(1), [wp.vec4(), wp.vec3(), wp.vec3()]
    moments, *shape = light.grid.shape[1:]
    lo, scale = box_arguments(light.aabb, (shape[0], shape[1], shape[2]))
    return light.moment, [wp.vec4(float(moments), *map(float, shape)), wp.vec3(*lo), wp.vec3(*scale)]


def _arguments(
    fields: Fields,
    light: Tensor,
    found: Marched,
    stands: Volume,
    moment: Tensor,
    shown: list[Any],
    counts_from: float,
) -> list[Any]:
    """Of both passes."""
    vec = _kernels(fields.features.shape[3])[0]
    lo, _, scale = corners_and_scale(stands)
    return [
        *found.rays,
        *(wp.vec3i(*stands.density.shape), wp.vec3(*lo), wp.vec3(*scale), vec5(*rules_of(stands))),
        *found.table,
        *(array(fields.density.reshape(-1)), array(fields.features, vec)),
        *(array(fields.own_density.reshape(-1)), array(fields.own_features, vec)),
        *(array(light.reshape(-1)), *shown, array(moment), counts_from),
    ]


@wp.func
@no_type_check
def scatter_one(values: wp.array(dtype=float), first: int, shape: wp.vec3i, q: wp.vec3, g: float):
    """Add to the eight vertices around index coordinates what `density_at` takes of them."""
    i = cell_of(q[0], shape[0])
    j = cell_of(q[1], shape[1])
    k = cell_of(q[2], shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    row = shape[2]
    at = first + (i * shape[1] + j) * row + k
    h = g * (1.0 - x)
    for _side in range(2):
        wp.atomic_add(values, at, h * (1.0 - y) * (1.0 - z))
        wp.atomic_add(values, at + 1, h * (1.0 - y) * z)
        wp.atomic_add(values, at + row, h * y * (1.0 - z))
        wp.atomic_add(values, at + row + 1, h * y * z)
        at += shape[1] * row
        h = g * x


@wp.func
@no_type_check
def slope_at(values: wp.array(dtype=float), first: int, shape: wp.vec3i, q: wp.vec3) -> wp.vec3:
    """By how much `density_at` rises with index coordinates."""
    i = cell_of(q[0], shape[0])
    j = cell_of(q[1], shape[1])
    k = cell_of(q[2], shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    row = shape[2]
    at = first + (i * shape[1] + j) * row + k
    slab = at + shape[1] * row
    near = wp.lerp(
        wp.lerp(values[at], values[at + 1], z), wp.lerp(values[at + row], values[at + row + 1], z), y
    )
    far = wp.lerp(
        wp.lerp(values[slab], values[slab + 1], z), wp.lerp(values[slab + row], values[slab + row + 1], z), y
    )
    left = wp.lerp(wp.lerp(values[at], values[at + 1], z), wp.lerp(values[slab], values[slab + 1], z), x)
    right = wp.lerp(
        wp.lerp(values[at + row], values[at + row + 1], z),
        wp.lerp(values[slab + row], values[slab + row + 1], z),
        x,
    )
    low = wp.lerp(wp.lerp(values[at], values[at + row], y), wp.lerp(values[slab], values[slab + row], y), x)
    high = wp.lerp(
        wp.lerp(values[at + 1], values[at + row + 1], y),
        wp.lerp(values[slab + 1], values[slab + row + 1], y),
        x,
    )
    free = wp.vec3(slope_of(q[0], shape[0]), slope_of(q[1], shape[1]), slope_of(q[2], shape[2]))
    return wp.cw_mul(wp.vec3(far - near, right - left, high - low), free)


@wp.func
@no_type_check
def shape_of(sizes: wp.vec4) -> wp.vec3i:
    """Vertices along x, y and z of the grid of brightness."""
    return wp.vec3i(int(sizes[1]), int(sizes[2]), int(sizes[3]))


@wp.func
@no_type_check
def layer_of(sizes: wp.vec4, layer: int, moment: float) -> int:
    """Where a layer of the grid of brightness begins at the moment before one."""
    k = cell_of(moment, int(sizes[0]))
    return (layer * int(sizes[0]) + k) * int(sizes[1]) * int(sizes[2]) * int(sizes[3])


@wp.func
@no_type_check
def light_at(grid: wp.array(dtype=float), sizes: wp.vec4, q: wp.vec3, layer: int, moment: float) -> float:
    """Logarithm of brightness at index coordinates of a layer, linear in place and time, held to the borders."""
    shape = shape_of(sizes)
    first = layer_of(sizes, layer, moment)
    a = density_at(grid, first, shape, q)
    b = density_at(grid, first + shape[0] * shape[1] * shape[2], shape, q)
    return wp.lerp(a, b, fraction_in(moment, cell_of(moment, int(sizes[0]))))


@functools.cache
def _kernels(channels: int) -> tuple[Any, Any, Any, Any]:
    vec = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def composited(
        start: int,
        rays_o: wp.array(dtype=wp.vec3),
        rays_d: wp.array(dtype=wp.vec3),
        frame: wp.array(dtype=wp.int64),
        back: wp.array2d(dtype=wp.mat33),
        shifts: wp.array2d(dtype=wp.vec3),
        shape: wp.vec3i,
        lo: wp.vec3,
        scale: wp.vec3,
        rules: vec5,
        ts: wp.array2d(dtype=float),
        found: wp.array2d(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        density: wp.array(dtype=float),
        features: wp.array3d(dtype=vec),
        own_density: wp.array(dtype=float),
        own_features: wp.array3d(dtype=vec),
        light: wp.array(dtype=float),
        light_sizes: wp.vec4,
        light_lo: wp.vec3,
        light_scale: wp.vec3,
        moment: wp.array(dtype=float),
        counts_from: float,
        out_features: wp.array(dtype=vec),
        out_light: wp.array(dtype=float),
        out_opacity: wp.array(dtype=float),
        out_left: wp.array(dtype=float),
        out_depth: wp.array(dtype=float),
    ):
        r = start + wp.tid()
        f = int(frame[r])
        left = float(1.0)
        depth = float(0.0)
        opacity = float(0.0)
        bright = float(0.0)
        mean = vec()
        for s in range(counts[r]):
            t = ts[s, r]
            m = found[s, r] - 1
            x = rays_o[r] + rays_d[r] * t
            raw = float(0.0)
            if m >= 0:
                x = back[f, m] * (x - shifts[f, m])
            q = wp.cw_mul(x - lo, scale)
            if m >= 0:
                raw = density_at(own_density, 0, shape, q)
            else:
                raw = density_at(density, 0, shape, q)
            alpha = alpha_of(raw + rules[0], rules[1])
            weight = left * alpha
            left *= 1.0 - alpha
            depth += weight * t
            if weight > counts_from:
                if m >= 0:
                    mean += look_up(own_features, q) * weight
                else:
                    mean += look_up(features, q) * weight
                opacity += weight
                if light_sizes[0] > 0.0:
                    place = wp.cw_mul(x - light_lo, light_scale)
                    bright += weight * light_at(light, light_sizes, place, wp.where(m >= 0, 1, 0), moment[f])
        out_features[r] = mean
        out_light[r] = bright
        out_opacity[r] = opacity
        out_left[r] = left
        out_depth[r] = depth

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def adjoint(
        start: int,
        rays_o: wp.array(dtype=wp.vec3),
        rays_d: wp.array(dtype=wp.vec3),
        frame: wp.array(dtype=wp.int64),
        back: wp.array2d(dtype=wp.mat33),
        shifts: wp.array2d(dtype=wp.vec3),
        shape: wp.vec3i,
        lo: wp.vec3,
        scale: wp.vec3,
        rules: vec5,
        ts: wp.array2d(dtype=float),
        found: wp.array2d(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        density: wp.array(dtype=float),
        features: wp.array3d(dtype=vec),
        own_density: wp.array(dtype=float),
        own_features: wp.array3d(dtype=vec),
        light: wp.array(dtype=float),
        light_sizes: wp.vec4,
        light_lo: wp.vec3,
        light_scale: wp.vec3,
        moment: wp.array(dtype=float),
        counts_from: float,
        sum_features: wp.array(dtype=vec),
        sum_light: wp.array(dtype=float),
        sum_opacity: wp.array(dtype=float),
        sum_left: wp.array(dtype=float),
        features_by: wp.array(dtype=vec),
        light_by: wp.array(dtype=float),
        opacity_by: wp.array(dtype=float),
        left_by: wp.array(dtype=float),
        thicker: wp.array2d(dtype=float),
        weights: wp.array2d(dtype=float),
        density_grad: wp.array(dtype=float),
        features_grad: wp.array3d(dtype=vec),
        own_density_grad: wp.array(dtype=float),
        own_features_grad: wp.array3d(dtype=vec),
        light_grad: wp.array(dtype=float),
    ):
        r = start + wp.tid()
        f = int(frame[r])
        g = features_by[r]
        behind = wp.dot(g, sum_features[r]) + light_by[r] * sum_light[r]
        behind += opacity_by[r] * sum_opacity[r] + left_by[r] * sum_left[r]
        left = float(1.0)
        for s in range(counts[r]):
            m = found[s, r] - 1
            x = rays_o[r] + rays_d[r] * ts[s, r]
            raw = float(0.0)
            if m >= 0:
                x = back[f, m] * (x - shifts[f, m])
            q = wp.cw_mul(x - lo, scale)
            if m >= 0:
                raw = density_at(own_density, 0, shape, q) + rules[0]
            else:
                raw = density_at(density, 0, shape, q) + rules[0]
            alpha = alpha_of(raw, rules[1])
            weight = left * alpha
            left *= 1.0 - alpha
            value = float(0.0)
            weights[s, r] = 0.0
            if weight > counts_from:
                weights[s, r] = weight
                value = opacity_by[r]
                if m >= 0:
                    value += wp.dot(g, look_up(own_features, q))
                    scatter(own_features_grad, q, g * weight)
                else:
                    value += wp.dot(g, look_up(features, q))
                    scatter(features_grad, q, g * weight)
                if light_sizes[0] > 0.0:
                    sizes = shape_of(light_sizes)
                    layer = wp.where(m >= 0, 1, 0)
                    at = wp.cw_mul(x - light_lo, light_scale)
                    first = layer_of(light_sizes, layer, moment[f])
                    after = first + sizes[0] * sizes[1] * sizes[2]
                    share = fraction_in(moment[f], cell_of(moment[f], int(light_sizes[0])))
                    value += light_by[r] * light_at(light, light_sizes, at, layer, moment[f])
                    by = light_by[r] * weight
                    scatter_one(light_grad, first, sizes, at, by * (1.0 - share))
                    scatter_one(light_grad, after, sizes, at, by * share)
            behind -= weight * value
            thick = rules[1] * sigmoid(raw) * (left * value - behind)
            thicker[s, r] = thick
            if m >= 0:
                scatter_one(own_density_grad, 0, shape, q, thick)
            else:
                scatter_one(density_grad, 0, shape, q, thick)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def places(
        start: int,
        rays_o: wp.array(dtype=wp.vec3),
        rays_d: wp.array(dtype=wp.vec3),
        frame: wp.array(dtype=wp.int64),
        back: wp.array2d(dtype=wp.mat33),
        shifts: wp.array2d(dtype=wp.vec3),
        shape: wp.vec3i,
        lo: wp.vec3,
        scale: wp.vec3,
        rules: vec5,
        ts: wp.array2d(dtype=float),
        found: wp.array2d(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        density: wp.array(dtype=float),
        features: wp.array3d(dtype=vec),
        own_density: wp.array(dtype=float),
        own_features: wp.array3d(dtype=vec),
        light: wp.array(dtype=float),
        light_sizes: wp.vec4,
        light_lo: wp.vec3,
        light_scale: wp.vec3,
        moment: wp.array(dtype=float),
        counts_from: float,
        features_by: wp.array(dtype=vec),
        light_by: wp.array(dtype=float),
        thicker: wp.array2d(dtype=float),
        weights: wp.array2d(dtype=float),
        back_grad: wp.array2d(dtype=wp.mat33),
        shifts_grad: wp.array2d(dtype=wp.vec3),
    ):
        r = start + wp.tid()
        f = int(frame[r])
        for s in range(counts[r]):
            m = found[s, r] - 1
            if m >= 0:
                place = rays_o[r] + rays_d[r] * ts[s, r] - shifts[f, m]
                x = back[f, m] * place
                q = wp.cw_mul(x - lo, scale)
                slope = wp.cw_mul(slope_at(own_density, 0, shape, q), scale) * thicker[s, r]
                weight = weights[s, r]
                if weight > 0.0:
                    slope += wp.cw_mul(dotted_slope(own_features, q, features_by[r]), scale) * weight
                    if light_sizes[0] > 0.0:
                        sizes = shape_of(light_sizes)
                        at = wp.cw_mul(x - light_lo, light_scale)
                        first = layer_of(light_sizes, 1, moment[f])
                        after = first + sizes[0] * sizes[1] * sizes[2]
                        share = fraction_in(moment[f], cell_of(moment[f], int(light_sizes[0])))
                        rise = wp.lerp(
                            slope_at(light, first, sizes, at), slope_at(light, after, sizes, at), share
                        )
                        slope += wp.cw_mul(rise, light_scale) * (light_by[r] * weight)
                wp.atomic_add(back_grad, f, m, wp.outer(slope, place))
                wp.atomic_add(shifts_grad, f, m, -(wp.transpose(back[f, m]) * slope))

    return vec, composited, adjoint, places
