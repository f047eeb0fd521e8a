"""Every kernel against its plain reference, forward and gradient, with points at edges and outside."""

import copy
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.kernels import adam
from devrf.reconstruct.kernels import background as around
from devrf.reconstruct.kernels.adam import add_total_variation, add_touched_variation, dense_step, masked_step
from devrf.reconstruct.kernels.background import (
    NEAR_SHARE,
    Contraction,
    Surroundings,
    background,
    background_ref,
    contract,
    expand,
)
from devrf.reconstruct.kernels.composite import accumulate, composite_weights, composite_weights_ref
from devrf.reconstruct.kernels.march import RaySegments, Volume, Warp, march, march_ref
from devrf.reconstruct.kernels.occupancy import (
    REACH,
    _moved_occupancy_ref,
    distance,
    distance_ref,
    moved_occupancy,
)
from devrf.reconstruct.kernels.quad import quad, quad_ref
from devrf.reconstruct.kernels.trilinear import trilinear, trilinear_ref
from devrf.reconstruct.storage.training_state import net_state, take_up_net

AABB = torch.tensor([[-1.0, -0.5, -0.8], [1.0, 0.7, 0.9]])
ROOM, WINDOW = Contraction(6.0), Contraction(20.0, 7.0)
# sums of eight products of order one, multiplied by up to ten vertices per unit
FLOAT32: dict[str, Any] = {"rtol": 1e-4, "atol": 1e-5}


def _points(n: int, generator: torch.Generator) -> torch.Tensor:
    """Points inside, outside and exactly on vertices, edges and corners."""
    lo, hi = AABB
    p = lo + (hi - lo) * (torch.rand(n, 3, generator=generator) * 1.4 - 0.2)
    on_vertex = torch.randint(0, 5, (n // 5, 3), generator=generator) / 4
    p[: n // 5] = lo + (hi - lo) * on_vertex
    return p


@pytest.mark.parametrize("channels", [1, 3, 4, 12])
def test_trilinear_matches_reference(channels: int) -> None:
    g = torch.Generator().manual_seed(channels)
    grid = torch.randn(9, 7, 8, channels, generator=g, requires_grad=True)
    points = _points(500, g)[100:].requires_grad_()  # at vertices the slope has two sides: values only, below
    out, ref = trilinear(grid, points, AABB), trilinear_ref(grid, points, AABB)
    torch.testing.assert_close(out, ref, rtol=1e-4, atol=1e-5)
    cotangent = torch.randn(out.shape, generator=g)
    for ours, theirs in zip(
        torch.autograd.grad(out, (grid, points), cotangent),
        torch.autograd.grad(ref, (grid, points), cotangent),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    vertices = _points(500, g)
    torch.testing.assert_close(
        trilinear(grid, vertices, AABB), trilinear_ref(grid, vertices, AABB), **FLOAT32
    )


def test_trilinear_reproduces_a_linear_function_and_its_slope() -> None:
    shape = (5, 6, 7)
    axes = [torch.linspace(a, b, n) for a, b, n in zip(*AABB.tolist(), shape, strict=True)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    grid = (2 * x - 3 * y + 0.5 * z + 1)[..., None]
    points = (AABB[0] + (AABB[1] - AABB[0]) * torch.rand(50, 3)).requires_grad_()
    out = trilinear(grid, points, AABB)
    torch.testing.assert_close(out[:, 0], points @ torch.tensor([2, -3, 0.5]) + 1, rtol=1e-4, atol=1e-5)
    (slope,) = torch.autograd.grad(out.sum(), points)
    torch.testing.assert_close(slope, torch.tensor([2, -3, 0.5]).expand(50, 3), rtol=1e-3, atol=1e-4)


def test_trilinear_adds_to_a_buffer_what_autograd_would_return() -> None:
    g = torch.Generator().manual_seed(0)
    grid, points = torch.randn(6, 5, 4, 3, generator=g), _points(100, g).requires_grad_()
    leaf = grid.clone().requires_grad_()
    trilinear(leaf, points, AABB).square().sum().backward()
    buffer = torch.ones_like(grid)
    trilinear(grid, points, AABB, buffer).square().sum().backward()
    assert leaf.grad is not None
    torch.testing.assert_close(buffer, leaf.grad + 1)


@pytest.mark.parametrize("keys", [2, 5])
def test_quad_matches_reference(keys: int) -> None:
    g = torch.Generator().manual_seed(keys)
    field = torch.randn(keys, 6, 7, 5, 3, generator=g, requires_grad=True)
    points = _points(400, g)[80:].requires_grad_()
    # before the first key and after the last, too
    tau = torch.rand(len(points), generator=g) * (keys + 1) - 1
    tau[:60] = tau[:60].round()
    out, ref = quad(field, points, tau, AABB), quad_ref(field, points, tau, AABB)
    torch.testing.assert_close(out, ref, rtol=1e-4, atol=1e-5)
    cotangent = torch.randn(out.shape, generator=g)
    ours = torch.autograd.grad(out, (field, points), cotangent)
    theirs = torch.autograd.grad(ref, (field, points), cotangent)
    torch.testing.assert_close(ours[0], theirs[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours[1], theirs[1], rtol=1e-4, atol=1e-4)
    buffer = torch.zeros_like(field[1:2])
    quad(field.detach(), points, tau, AABB, buffer, 1).backward(cotangent)
    torch.testing.assert_close(buffer, theirs[0][1:2], rtol=1e-4, atol=1e-4)


def test_composite_matches_reference_and_conserves_light() -> None:
    g = torch.Generator().manual_seed(0)
    counts = torch.randint(0, 9, (40,), generator=g)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    alpha = torch.rand(int(offsets[-1]), generator=g).requires_grad_()
    out, ref = composite_weights(alpha, offsets), composite_weights_ref(alpha, offsets)
    cotangent = [torch.randn(x.shape, generator=g) for x in out]
    for ours, theirs in zip(out, ref, strict=True):
        torch.testing.assert_close(ours, theirs)
    ours = torch.autograd.grad(out, alpha, cotangent)[0]
    theirs = torch.autograd.grad(ref, alpha, cotangent)[0]
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    ray_id = torch.repeat_interleave(torch.arange(40), counts)
    absorbed = accumulate(out[0].detach(), torch.ones(len(alpha), 1), ray_id, 40)[:, 0]
    torch.testing.assert_close(absorbed + out[1].detach(), torch.ones(40))


@pytest.mark.parametrize("value", [0.0, 1e-8, 1.0])
def test_composite_is_finite_at_extremes(value: float) -> None:
    alpha = torch.full((6,), value, requires_grad=True)
    weights, left = composite_weights(alpha, torch.tensor([0, 6]))
    (weights.square().sum() + left.sum()).backward()
    assert alpha.grad is not None and torch.isfinite(alpha.grad).all()


def test_distance_matches_reference() -> None:
    occupied = torch.rand(21, 17, 30, generator=torch.Generator().manual_seed(0)) > 0.998
    assert torch.equal(distance(occupied), distance_ref(occupied))
    assert (distance(torch.zeros(4, 4, 4, dtype=torch.bool)) == REACH).all()


def test_moved_occupancy_matches_reference() -> None:
    g = torch.Generator().manual_seed(0)
    rest = distance(torch.rand(20, 21, 22, generator=g) > 0.99)
    field = torch.randn(4, 5, 6, 7, 3, generator=g) * 0.2
    taus = torch.tensor([0.0, 1.3, 3.0])
    arguments = ((11, 12, 13), AABB * 1.3, field, taus, rest, AABB, 2)
    ours, theirs = moved_occupancy(*arguments), _moved_occupancy_ref(*arguments)
    assert (ours != theirs).float().mean() < 1e-3  # a rounding tie may fall either way
    assert 0.1 < ours.float().mean() < 0.9


def _rays(n: int, g: torch.Generator, box: torch.Tensor) -> RaySegments:
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1) * 3
    towards = (torch.rand(n, 3, generator=g) - 0.5) - origins
    d = torch.nn.functional.normalize(towards, dim=-1)
    a, b = (box[0] - origins) / d, (box[1] - origins) / d
    t_in, t_out = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
    return RaySegments(origins, d, t_in, torch.maximum(t_in, t_out), torch.rand(n, generator=g))


def _volume(g: torch.Generator) -> Volume:
    density = torch.randn(20, 16, 18, generator=g) * 3 - 2
    occupied = torch.zeros_like(density, dtype=torch.bool)
    occupied[4:14, 3:12, 6:9] = True
    return Volume(density, distance(occupied), AABB, -1.0, 0.5, 0.05, 1e-4, 1e-4)


@pytest.mark.parametrize("moving", [False, True])
def test_march_matches_reference(moving: bool) -> None:
    g = torch.Generator().manual_seed(1)
    volume, warp, box = _volume(g), None, AABB
    if moving:
        box = AABB * 1.2
        field = torch.randn(3, 4, 4, 4, 3, generator=g) * 0.1
        tau = torch.rand(200, generator=g) * 2
        live = moved_occupancy((24, 24, 24), box, field, torch.linspace(0, 2, 9), volume.distance, AABB, 4)
        warp = Warp(field, tau, box, distance(live))
    rays = _rays(200, g, box)
    ours, theirs = march(rays, volume, warp), march_ref(rays, volume, warp)
    different = (ours.offsets.diff() != theirs.offsets.diff()).float().mean()
    assert different < 0.02  # rounding at a threshold or at a border may go either way
    if different == 0:
        torch.testing.assert_close(ours.t, theirs.t, rtol=1e-4, atol=1e-4)
    assert len(ours.t) > 500
    assert (ours.t.diff()[ours.ray_id.diff() == 0] > 0).all()


def test_warp_out_of_the_box_is_empty_and_counted() -> None:
    g = torch.Generator().manual_seed(2)
    volume = _volume(g)
    field = torch.zeros(2, 2, 2, 2, 3) + torch.tensor([5.0, 0, 0])
    everywhere = torch.zeros(8, 8, 8, dtype=torch.uint8)
    rays = _rays(100, g, AABB)
    samples = march(rays, volume, Warp(field, torch.zeros(100), AABB, everywhere))
    assert len(samples.t) == 0
    assert samples.left_box == samples.seen and samples.seen > 0


def test_zero_motion_marches_as_at_rest() -> None:
    g = torch.Generator().manual_seed(3)
    volume, rays = _volume(g), _rays(100, g, AABB)
    everywhere = torch.zeros(8, 8, 8, dtype=torch.uint8)
    still = Warp(torch.zeros(2, 3, 3, 3, 3), torch.rand(100), AABB, everywhere)
    a, b = march(rays, volume), march(rays, volume, still)
    assert abs(len(a.t) - len(b.t)) <= 2
    if len(a.t) == len(b.t):
        torch.testing.assert_close(a.t, b.t, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize(("share", "contraction"), [(0.5, ROOM), (0.01, ROOM), (0.01, WINDOW)])
def test_background_matches_reference(closed: bool, share: float, contraction: Contraction) -> None:
    g = torch.Generator().manual_seed(4)
    grid = torch.randn(15, 16, 17, 4, generator=g)
    grid[..., 0] = grid[..., 0] * 2 - 3
    occupied = torch.rand(15, 16, 17, generator=g) < share  # little: most steps are leaps
    surroundings = Surroundings(
        grid.requires_grad_(), distance(occupied), AABB, 0.0, 0.7, 0.06, 1e-4, contraction
    )
    rays = _rays(150, g, AABB)._replace(t_in=torch.full((150,), 0.3), t_out=torch.full((150,), 9.0))
    target = torch.rand(150, 3, generator=g)
    out = background(rays, surroundings, closed, target)
    ref = background_ref(rays, surroundings, closed, target)
    near = [(a - b).abs().reshape(150, -1).amax(1) for a, b in zip(out, ref, strict=True)]
    # a sample at a vertex border may be occupied in one and not in the other
    same = torch.stack(near).amax(0) < 1e-3
    assert same.float().mean() > 0.9
    assert all((n[same] < 2e-4).all() for n in near)
    cotangent = [torch.randn(x.shape, generator=g) for x in out]
    cotangent = [c * same.reshape(-1, *[1] * (c.ndim - 1)) for c in cotangent]
    ours = torch.autograd.grad(out, grid, cotangent)[0]
    theirs = torch.autograd.grad(ref, grid, cotangent)[0]
    assert (ours - theirs).norm() < 0.01 * theirs.norm()
    for copies in (1, 2):
        buffer = torch.zeros(copies, *grid.shape)
        again = background(rays, surroundings, closed, target, buffer)
        torch.autograd.backward(again, cotangent)
        assert (buffer != 0).flatten(1).any(1).all()
        torch.testing.assert_close(buffer.sum(0), ours)


@pytest.mark.parametrize("reach", [6.0, 24.0])
@pytest.mark.parametrize("size", [9, 40])
def test_training_keeps_every_sample_of_rays_that_begin_in_the_cube(reach: float, size: int) -> None:
    """Everywhere something thin: as many samples count as there can be, and pictures without gradients are the same."""
    g, step = torch.Generator().manual_seed(1), 4 / (size - 1)
    grid = torch.full((size, size, size, 4), -9.0)
    everywhere = torch.zeros(size, size, size, dtype=torch.uint8)
    surroundings = Surroundings(
        grid.requires_grad_(), everywhere, AABB, 0.0, 1.0, step, 0.0, Contraction(reach, 3.0)
    )
    lo, hi = AABB
    corner = (torch.randint(0, 2, (200, 3), generator=g) * 2 - 1) * (reach - 0.01)
    through = torch.rand(200, 3, generator=g) * 0.2 - 0.1
    o, towards = ((u * (hi - lo) + lo + hi) / 2 for u in (corner, through))
    nothing = torch.zeros(200)
    rays = RaySegments(
        o, torch.nn.functional.normalize(towards - o), nothing, nothing, torch.rand(200, generator=g)
    )
    kept = background(rays, surroundings, True)
    with torch.no_grad():
        plain = background(rays, surroundings, True)
    for a, b in zip(kept, plain, strict=True):
        assert torch.equal(a, b)
    (ts, _, counts) = kept[0].grad_fn.rest[-1]  # type: ignore[union-attr]
    assert 0.5 * len(ts) < int(counts.max()) < len(ts)


def test_background_learns_without_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(around, "use_warp", lambda device: False)
    grid = torch.zeros(9, 9, 9, 4)
    nothing_empty = torch.zeros(9, 9, 9, dtype=torch.uint8)
    surroundings = Surroundings(grid, nothing_empty, AABB, 0.0, 0.7, 0.1, 1e-4, ROOM)
    rays = _rays(20, torch.Generator().manual_seed(0), AABB)
    buffer = torch.zeros(1, *grid.shape)
    colours, _, _ = background(rays, surroundings, True, None, buffer)
    colours.sum().backward()
    assert buffer.abs().sum() > 0 and grid.grad is None


@pytest.mark.parametrize("reach", [6.0, 20.0])
def test_contraction_keeps_the_box_and_brings_infinity_to_two(reach: float) -> None:
    u = torch.tensor([[0.5, -1.0, 0.2], [reach**0.5, 0, 0], [1e9, 1e9, -1e9]])
    expected = torch.tensor([[0.5, -1.0, 0.2], [1.5, 0, 0], [2.0, 2.0, -2.0]])
    torch.testing.assert_close(contract(u, Contraction(reach)), expected)


def test_most_depth_is_spent_on_what_is_near() -> None:
    u = torch.tensor([[0.5, -1.0, 0.2], [0, 7.0**0.5, 0], [0, 7.0, 0], [0, (7 * 20) ** 0.5, 0], [0, 30.0, 0]])
    expected = torch.tensor([1.0, 1 + NEAR_SHARE / 2, 1 + NEAR_SHARE, 1.5 + NEAR_SHARE / 2, 2.0])
    torch.testing.assert_close(contract(u, WINDOW).abs().amax(-1), expected)
    assert Contraction(20.0, 18.0).slopes == Contraction(20.0).slopes  # little is left to give


@pytest.mark.parametrize("contraction", [ROOM, Contraction(20.0), WINDOW])
def test_expand_undoes_contraction(contraction: Contraction) -> None:
    reach = contraction.reach
    u = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 2 * reach - reach
    torch.testing.assert_close(expand(contract(u, contraction), contraction), u, rtol=1e-5, atol=1e-5)


def test_adam_matches_torch() -> None:
    g = torch.Generator().manual_seed(5)
    start = torch.randn(50, 3, generator=g)
    ours, theirs = [start.clone(), start.clone()], torch.nn.Parameter(start.clone())
    state = [[torch.zeros_like(start) for _ in range(3)] for _ in ours]
    optimiser = torch.optim.Adam([theirs], lr=0.1, betas=(0.9, 0.99), eps=1e-8)
    for step in range(1, 6):
        gradient = torch.randn(start.shape, generator=g)
        theirs.grad = gradient
        optimiser.step()
        for values, (grad, m, v), masked in zip(ours, state, (True, False), strict=True):
            grad.copy_(gradient)
            copies = torch.stack([0.25 * grad, 0.75 * grad])
            if masked:
                masked_step(values, copies, m, v, torch.arange(50), step, 0.1, (0.9, 0.99), 1e-8)
            else:
                dense_step(values, grad, m, v, step, 0.1, (0.9, 0.99), 1e-8)
            torch.testing.assert_close(values, theirs.detach(), rtol=1e-4, atol=1e-5)
            assert torch.count_nonzero(copies if masked else grad) == 0


def test_one_vector_of_parameters_is_trained_as_torch_does() -> None:
    torch.manual_seed(3)
    ours = torch.nn.Sequential(torch.nn.Linear(4, 5), torch.nn.ReLU(), torch.nn.Linear(5, 2))
    theirs, x = copy.deepcopy(ours), torch.randn(7, 4)
    mine, reference = FlatAdam(ours), torch.optim.Adam(theirs.parameters(), 0.01, (0.9, 0.99), eps=1e-8)
    for _ in range(20):
        (ours(x) ** 2).sum().backward()
        mine.step(0.01)
        (theirs(x) ** 2).sum().backward()
        reference.step()
        reference.zero_grad()
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    again = FlatAdam(copy.deepcopy(ours))
    take_up_net(again, {key: value.clone() for key, value in net_state(mine).items()})
    for each, module in ((mine, ours), (again, again.module)):
        (module(x) ** 2).sum().backward()
        each.step(0.01)
    assert torch.equal(mine.values, again.values) and mine.steps == again.steps == 21


def test_trainings_do_without_the_optimisers_of_torch() -> None:
    """Importing them takes two seconds of each process."""
    code = "import sys, torch, devrf.reconstruct.recipe; "
    code += (
        "from devrf.reconstruct.fields.flat_adam import FlatAdam; FlatAdam(torch.nn.Linear(2, 2)).step(0.1); "
    )
    code += "print('torch._dynamo' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_masked_adam_leaves_untouched_values_alone() -> None:
    values, grad = torch.zeros(4, 2), torch.tensor([[1.0, 0], [0, 0], [1.0, 1.0], [1.0, 1.0]])
    masked_step(
        values,
        grad[None],
        torch.zeros(4, 2),
        torch.zeros(4, 2),
        torch.tensor([0, 1, 2]),
        1,
        0.1,
        (0.9, 0.99),
        1e-8,
    )
    np.testing.assert_allclose(values, [[-0.1, 0], [0, 0], [-0.1, -0.1], [0, 0]], atol=1e-6)


def test_masked_adam_clears_gradients_whose_squares_vanish() -> None:
    grad = torch.full((2, 3, 4), 1e-30)
    zeros = [torch.zeros(3, 4) for _ in range(3)]
    masked_step(zeros[0], grad, zeros[1], zeros[2], torch.arange(3), 1, 0.1, (0.9, 0.99), 1e-8)
    assert torch.count_nonzero(grad) == 0


def test_total_variation_is_the_gradient_of_squared_differences() -> None:
    values = torch.randn(4, 5, 6, 3, generator=torch.Generator().manual_seed(6)).requires_grad_()
    energy = torch.stack([(values.diff(dim=axis) ** 2).sum() for axis in range(3)]).sum() / 2
    (expected,) = torch.autograd.grad(energy, values)
    grad = torch.zeros_like(values)
    add_total_variation(values.detach(), grad, 6.0, 1e9)
    torch.testing.assert_close(grad, expected, rtol=1e-4, atol=1e-5)
    held = torch.zeros_like(values)
    add_total_variation(values.detach() * 1e6, held, 6.0, 1.0)
    assert held.abs().max() <= 6.0


@pytest.mark.parametrize("warp", [True, False])
def test_total_variation_of_what_is_touched_leaves_the_rest_alone(
    warp: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values that have no gradient, and vertices that are not listed, get none."""
    monkeypatch.setattr(adam, "use_warp", lambda device: warp)
    generator = torch.Generator().manual_seed(6)
    values, before = (
        torch.randn(4, 5, 6, 3, generator=generator),
        torch.randn(2, 4, 5, 6, 3, generator=generator),
    )
    before *= torch.rand(2, 4, 5, 6, 3, generator=generator) > 0.6
    whole, found, weights = torch.zeros_like(values), before.clone(), torch.tensor([0.0, 1.0, 2.0])
    add_total_variation(values, whole, 1.0, 0.5)
    listed = torch.rand(4, 5, 6, generator=generator) > 0.3
    add_touched_variation(values, found, listed.flatten().nonzero()[:, 0], weights, 0.5)
    asked = (before != 0).any(0) & listed[..., None]
    assert 0.1 < asked.float().mean() < 0.9
    torch.testing.assert_close(found[0] - before[0], asked * weights * whole)
    assert torch.equal(found[1], before[1])
