"""Grids, opacity, occupancy and colour of the scene at rest; its surroundings; the visual hull."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.make.models import canonical

from devrf.capture.scene import SparsePoints
from devrf.reconstruct.adapt.background_reach import FARTHEST_REACH, contraction_of
from devrf.reconstruct.adapt.hull import box_of, visual_hull
from devrf.reconstruct.fields.canonical import EMPTY, Canonical, shift_for
from devrf.reconstruct.fields.contracted_background import CUBE, REACH, Shell, grey
from devrf.reconstruct.fields.grids import grid_shape, grown, upsample, vertices, voxel_size
from devrf.reconstruct.kernels.background import Contraction
from devrf.reconstruct.options import PRESETS, Overrides, preset
from devrf.reconstruct.rendering.rays import Rays
from devrf.reconstruct.rendering.render import Grads, Rendered, render_rest

AABB = torch.tensor([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.25]])


def _canonical(resolution: float = 16) -> Canonical:
    return canonical(AABB, resolution, 16)


def test_grid_has_the_wanted_volume_in_proportion_to_the_box() -> None:
    shape = grid_shape(AABB, 64)
    assert shape[0] == pytest.approx(2 * shape[1], abs=1) and shape[1] == pytest.approx(2 * shape[2], abs=1)
    assert shape[0] * shape[1] * shape[2] == pytest.approx(64**3, rel=0.05)
    assert min(grid_shape(torch.tensor([[0.0, 0, 0], [1e-3, 1, 1]]), 8)) == 2


def test_upsampling_keeps_a_linear_function() -> None:
    coarse, fine = vertices(AABB, (4, 5, 3)), vertices(AABB, (9, 7, 8))
    torch.testing.assert_close(upsample(coarse, (9, 7, 8)), fine, rtol=1e-5, atol=1e-6)


def test_opacity_is_alpha_init_where_nothing_is_known() -> None:
    model = _canonical()
    per_base_voxel = 1 - (1 - model.alpha(torch.zeros(1, 3))) ** (1 / model.interval)
    assert per_base_voxel.item() == pytest.approx(1e-2, rel=1e-4)
    assert shift_for(0.5) == pytest.approx(0.0)


def test_opacity_of_a_length_does_not_depend_on_resolution() -> None:
    alphas = []
    for resolution in (8, 16):
        model = _canonical(resolution)
        model.density += 2.0
        steps = 0.1 / model.step
        alphas.append(1 - (1 - model.alpha(torch.zeros(1, 3)).item()) ** steps)
    assert alphas[0] == pytest.approx(alphas[1], rel=1e-4)


def _rays_into(model: Canonical, n: int = 50) -> Rays:
    """Rays from above through random points of the box, and some that miss it."""
    g = torch.Generator().manual_seed(1)
    through = AABB[0] + (AABB[1] - AABB[0]) * torch.rand(n, 3, generator=g)
    through[::7, 0] += 5.0
    origin = torch.tensor([0.3, 0.2, 3.0]).expand(n, 3).contiguous()
    d = through - origin
    return Rays(origin, d / d.norm(dim=1, keepdim=True), 0.1, torch.rand(2, n, generator=g))


def _rendered(model: Canonical, deferred: bool, grads: Grads = (None, None, None)) -> Rendered:
    model.deferred = deferred
    return render_rest(model, None, _rays_into(model), grads=grads)


def test_deferred_colours_are_those_of_the_samples_where_features_do_not_vary() -> None:
    model = _canonical()
    g = torch.Generator().manual_seed(0)
    model.density += 3 * torch.randn(model.density.shape, generator=g)
    model.features += torch.randn(4, generator=g)
    model.rebuild_occupancy()
    by_sample, by_ray = (_rendered(model, deferred) for deferred in (False, True))
    assert by_ray.colours is None and 0.1 < float(by_ray.left.mean()) < 0.9
    torch.testing.assert_close(by_ray.rgb, by_sample.rgb, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(by_ray.depth, by_sample.depth, rtol=1e-4, atol=1e-5)
    model.features += torch.randn(model.features.shape, generator=g)
    by_sample, by_ray = (_rendered(model, deferred) for deferred in (False, True))
    assert float((by_ray.rgb - by_sample.rgb).detach().abs().max()) > 1e-3  # else nothing was deferred


def test_deferred_colours_have_the_gradient_that_differences_show() -> None:
    model = canonical(AABB, 8)
    g = torch.Generator().manual_seed(0)
    model.density += 2 * torch.randn(model.density.shape, generator=g)
    model.features += torch.randn(model.features.shape, generator=g)
    model.alpha_threshold = model.weight_threshold = -1.0  # no sample comes or goes
    model.rebuild_occupancy()
    for place, grid in enumerate((model.density, model.features)):
        grads = torch.zeros_like(model.density), torch.zeros_like(model.features), None
        _rendered(model, True, grads).rgb.square().sum().backward()
        towards = torch.randn(grid.shape, generator=g)
        sums = []
        for step in (-1e-2, 1e-2):
            grid += step * towards
            sums.append(float(_rendered(model, True).rgb.detach().square().sum()))
            grid -= step * towards
        slope = float((grads[:2][place] * towards).sum())
        assert slope == pytest.approx((sums[1] - sums[0]) / 2e-2, rel=0.02)


def test_rays_that_meet_nothing_have_no_deferred_colour() -> None:
    model = _canonical()
    model.density.fill_(EMPTY)
    model.rebuild_occupancy()
    out = _rendered(model, True)
    assert not out.rgb.any() and not out.depth.any() and bool((out.left == 1).all())


def test_occupancy_holds_everything_that_counts_and_grows_back() -> None:
    model = _canonical()
    model.density.fill_(EMPTY)
    model.density[5:7, 3:5, 2:4] = 5.0
    reachable = model.rebuild_occupancy()
    points = AABB[0] + (AABB[1] - AABB[0]) * torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    counts = model.alpha(points) > model.alpha_threshold
    vertex = ((points - AABB[0]) / (AABB[1] - AABB[0]) * (torch.tensor(model.shape) - 1)).round().long()
    assert counts.any()
    assert (model.distance[tuple(vertex[counts].unbind(-1))] == 0).all()
    assert reachable.float().mean() < 0.5
    model.density[12, 5, 2] = 5.0  # occupied again after having been empty
    model.rebuild_occupancy()
    assert model.distance[12, 5, 2] == 0


def test_colour_depends_on_the_view_and_is_the_same_for_the_same_seed() -> None:
    x, ray_id = torch.zeros(2, 3), torch.tensor([0, 1])
    directions = torch.tensor([[1.0, 0, 0], [0, 0, 1.0]])
    model = _canonical()
    colours, again = (m.net(m.features_at(x), directions, ray_id) for m in (model, _canonical()))
    assert (colours[0] - colours[1]).abs().max() > 1e-4
    torch.testing.assert_close(colours, again)


def test_shell_is_empty_in_the_box_only() -> None:
    shell = Shell(AABB, grey(33), 33, near=0.4).begun()
    y = vertices(CUBE, (33, 33, 33))
    inside = y.abs().amax(-1) < 0.7
    assert (shell.grid[..., 0][inside] == EMPTY).all()
    assert (shell.grid[..., 0] == 0).float().mean() > 0.5
    outside = y.abs().amax(-1) > 1.1
    assert (shell.grid[..., 0][outside] == 0).all()  # also near a camera: what stands there is seen by others
    shell.refine(48)
    assert (shell.grid[..., 0][vertices(CUBE, (48, 48, 48)).abs().amax(-1) < 0.7] == EMPTY).all()


def test_surroundings_reach_as_far_as_the_points(ball) -> None:
    """A wall beyond the reach lies on the cube's faces, as if infinitely far away: from elsewhere it hangs wrong."""

    def contraction(*away: float) -> Contraction:
        xyz = np.array([[0.0, share * ball.scene.aabb[1, 1], 0.0] for share in away]).reshape(-1, 3)
        none = np.zeros(0, np.int64)
        return contraction_of(replace(ball.scene, points=SparsePoints(xyz, none, none)))

    assert contraction(1.0, 3.0) == Contraction(REACH, REACH)
    assert 10 < contraction(1.0, 2.0, 10.0, 10.0).reach < 12
    window = contraction(*[1.0] * 990, *[10.0] * 10)  # a garden behind a wall
    assert 10 < window.reach < 12 and window.bend == REACH
    assert contraction(*[1.0] * 997, *[10.0] * 3).reach == REACH  # points that are wrong
    assert contraction(1.0, 1e3, 1e3).reach == FARTHEST_REACH
    nobody_knows = contraction_of(replace(ball.scene, points=None))
    assert contraction() == nobody_knows == Contraction(FARTHEST_REACH, REACH)


def test_a_test_camera_farther_away_changes_no_reach(ball) -> None:
    away = np.eye(4)
    away[:3, 3] = 50.0
    far = replace(ball.scene.static[0], camera=ball.scene.static[0].camera.moved(away), split="test")
    with_it = replace(ball.scene, dynamic=(*ball.scene.dynamic, far))
    none = np.zeros(0, np.int64)
    for points in (None, SparsePoints(np.zeros((1, 3)), none, none)):
        of = [contraction_of(replace(scene, points=points)) for scene in (ball.scene, with_it)]
        assert of[0] == of[1]


def test_hull_contains_the_ball_and_little_else(ball) -> None:
    scene = ball.scene
    aabb = torch.tensor(scene.aabb, dtype=torch.float32)
    frames = [f for f in scene.static if f.split == "train"]
    kept = visual_hull(frames, aabb, (24, 24, 24), scene.background)
    inside = vertices(aabb, (24, 24, 24)).norm(dim=-1) < ball.radius
    assert kept[inside].all()
    box = box_of(kept, aabb, 1.0)
    assert box is not None and (box.abs() < ball.radius + 0.25).all()
    assert box_of(torch.zeros(4, 4, 4, dtype=torch.bool), aabb, 1.0) is None


def test_grown_adds_neighbours_only() -> None:
    one = torch.zeros(5, 5, 5, dtype=torch.bool)
    one[2, 2, 2] = True
    assert grown(one).sum() == 27


def test_presets_take_single_numbers() -> None:
    options = preset(
        "tiny", Overrides(resolution=56, rays=100, canonical_iterations=7, motion_iterations=10, seed=3)
    )
    assert options.canonical.resolution == 56 and options.canonical.rays == options.motion.rays == 100
    assert options.canonical.iterations == 7 and options.canonical.seed == options.motion.seed == 3
    ratio = 56 / PRESETS["tiny"].canonical.resolution
    for level, whole in zip(options.motion.levels, PRESETS["tiny"].motion.levels, strict=True):
        assert level == max(4, round(whole * ratio))
    assert sum(options.motion.iterations) == pytest.approx(10, abs=2)
    with pytest.raises(ValueError, match="'small'.* tiny, fast, reference"):
        preset("small")


def test_voxel_size_is_the_edge_of_a_cube() -> None:
    assert voxel_size(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), (11, 11, 11)) == pytest.approx(0.1)
