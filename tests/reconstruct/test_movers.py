"""What stands and what moves: rendered, trained, saved, and asked where points are."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.reconstruct.conftest import RADIUS, TRAVEL, Ball, ball_clips, look_at
from tests.reconstruct.deaths import until_done

import devrf.reconstruct.kernels.layers as layers_module
import devrf.reconstruct.rendering.layered as layered_module
import devrf.reconstruct.training.train_motion as train_motion_module
import devrf.reconstruct.training.train_movers as train_movers_module
from devrf.capture.scene import Scene
from devrf.flow.dis import DisFlow
from devrf.pipelines.health.judge import judge
from devrf.pipelines.health.training_rows import moved_clock_measures, mover_measures
from devrf.reconstruct import recipe
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.evaluation.left_out import left_out
from devrf.reconstruct.evaluation.left_out_errors import Errors, errors_in_motion
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.movers import Movers
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.fields.pose_corrections import Corrections
from devrf.reconstruct.fields.shading import Shading
from devrf.reconstruct.geometry.field import field_at, moved
from devrf.reconstruct.kernels.composite_layers import Fields
from devrf.reconstruct.kernels.layers import march_layers, march_layers_ref
from devrf.reconstruct.options import PRESETS, MotionOptions
from devrf.reconstruct.rendering.layered import draw_layered, render_layered
from devrf.reconstruct.rendering.model import DynamicModel, render_layers, render_view
from devrf.reconstruct.rendering.rays import Rays, camera_rays
from devrf.reconstruct.sampling.clean_plate import standing_clips
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.storage.model_io import load_deformation, save_deformation, save_rest
from devrf.reconstruct.tracking.find import AtRest, TrackedParts, find_movers, parts_of, why_not_tracked
from devrf.reconstruct.tracking.follow import SurfaceTracks
from devrf.reconstruct.tracking.solver.graph import Graph
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.training.guard import diverged
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.moving_parts import DOUBTED_DB
from devrf.reconstruct.training.train_movers import TrainedParts, _Recipe, train_movers, untrained_errors

TURN = np.array([0.2, -0.3, 0.4])
STRETCH = np.array([[1.25, 0.08, 0.0], [0.08, 0.85, -0.05], [0.0, -0.05, 1.1]])
COST = {
    "seconds": 1.0, "iterations": 5, "rays": 9, "restarts": 0, "rate": 1.0, "peak_rss_gb": 1.0, "peak_gpu_gb": None
}  # fmt: skip
TIMES = 9  # fewer say nothing of chance
OPTIONS = MotionOptions(levels=(4,), iterations=(1,), rays=64, together=30, together_rays=512)


def halves(rest: RestModel) -> tuple[Canonical, Canonical, torch.Tensor]:
    """What is left of the middle stands, what is right of it moves; labels."""
    canonical = rest.canonical
    places = vertices(canonical.aabb, canonical.shape)
    right = places[..., 0] > 0
    return canonical.only(~right), canonical.only(right), (right & (canonical.distance <= 1)).to(torch.uint8)


def still(own: Canonical, labels: torch.Tensor, parts: int = 1) -> Movers:
    turn = torch.eye(3).expand(3, parts, 3, 3).clone()
    return Movers(own, labels, torch.tensor([0.0, 0.5, 1.0]), turn, torch.zeros(3, parts, 3))


def whole(
    rest: RestModel, travel: np.ndarray, turn: np.ndarray | None = None, stretch: np.ndarray | None = None
) -> DynamicModel:
    """All of the ball is one part that goes, turns and stretches evenly."""
    canonical = rest.canonical
    labels = (canonical.distance <= 1).to(torch.uint8)
    stands = canonical.only(torch.zeros_like(labels, dtype=torch.bool))
    movers = still(canonical, labels)
    for n, time in enumerate((0.0, 0.5, 1.0)):
        movers.shifts[n, 0] = torch.from_numpy(time * travel)
        if turn is not None:
            movers.rotations[n, 0] = torch.from_numpy(Rotation.from_rotvec(time * turn).as_matrix())
    if stretch is not None:
        shares = np.array([0.0, 0.5, 1.0])[:, None, None]
        movers.stretches = torch.from_numpy(np.eye(3) + shares * (stretch - np.eye(3))).float()[:, None]
    return DynamicModel.of_movers(rest, replace(rest, canonical=stands), movers, 5, 0.0)


@pytest.mark.parametrize("deferred", [False, True])
def test_parts_that_do_not_move_look_as_at_rest(rest: RestModel, deferred: bool) -> None:
    rest = replace(rest, canonical=copy.copy(rest.canonical))
    rest.canonical.deferred = deferred
    stands, own, labels = halves(rest)
    model = DynamicModel.of_movers(rest, replace(rest, canonical=stands), still(own, labels), 3, 0.0)
    camera = look_at(np.array([1.5, 2.0, 0.7]))
    at_rest, apart = render_view(model, camera, None), render_view(model, camera, 0.4)
    assert np.abs(at_rest - apart).mean() < 0.01 and np.abs(at_rest - 1).mean() > 0.05


def test_layers_are_shown_alone(rest: RestModel) -> None:
    """A quarter of the ball stands, each of two parts is some of the rest; together they are the ball."""
    stands, own, labels = halves(rest)
    places = vertices(own.aabb, own.shape)
    labels = torch.where((labels > 0) & (places[..., 2] > 0), 2, labels).to(torch.uint8)
    model = DynamicModel.of_movers(rest, replace(rest, canonical=stands), still(own, labels, 2), 3, 0.0)
    camera = look_at(np.array([1.5, 2.0, 0.7]))

    def opacity(stands: bool, parts: tuple[int, ...]) -> float:
        return float(render_layers(model.showing(stands, parts), camera, 0.4)[2].sum())

    everything = float(render_layers(model, camera, 0.4)[2].sum())
    assert opacity(True, (1, 2)) == pytest.approx(everything, rel=1e-3) and opacity(False, ()) == 0
    each = opacity(True, ()), opacity(False, (1,)), opacity(False, (2,))
    assert min(each) > 0.1 * everything
    assert sum(each) > 0.95 * everything and max(each) < 0.7 * everything
    assert opacity(False, (1, 2)) == pytest.approx(each[1] + each[2], rel=0.1)


def test_a_part_looks_as_from_a_camera_that_moves_the_other_way(rest: RestModel) -> None:
    travel = np.array([0.2, -0.1, 0.15])
    model = whole(rest, travel, TURN)
    camera = look_at(np.array([1.5, 2.0, 0.7]))
    for time in (0.25, 0.5, 1.0):  # between moments, too: places go straight, turns are even
        back = np.eye(4)
        back[:3, :3] = Rotation.from_rotvec(time * TURN).as_matrix()
        back[:3, 3] = time * travel
        seen = render_view(model, camera, time)
        other = render_view(model, camera.moved(np.linalg.inv(back)), None)
        middles = model.movers.middles()[0] if model.movers is not None else np.zeros(3)
        assert np.abs(middles).max() < 0.05  # else a turn about it would not be even
        assert np.abs(seen - other).mean() < 0.004
    assert np.abs(render_view(model, camera, 1.0) - render_view(model, camera, None)).mean() > 0.03


@pytest.mark.parametrize("deferred", [False, True])
def test_a_soft_part_is_drawn_stretched(rest: RestModel, deferred: bool) -> None:
    """The outline is that of the ball's points, moved."""
    rest = replace(rest, canonical=copy.copy(rest.canonical))
    rest.canonical.deferred = deferred
    camera = look_at(np.array([1.5, 2.0, 0.7]))
    model = whole(rest, np.array([0.1, -0.05, 0.1]), TURN, STRETCH)
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    on_ball = RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for time in (0.0, 0.75, 1.0):
        opaque = render_layers(model.alone("black"), camera, time)[2] > 0.5
        at = camera.project(moved(model, on_ball, None, time))
        hit = opaque[tuple(at.round().astype(int).T[::-1])]
        assert hit.mean() > 0.85  # the outline itself is half in, half out
        lo, hi = (f(at, axis=0) for f in (np.min, np.max))
        y, x = np.nonzero(opaque)
        assert np.allclose([x.min(), y.min(), x.max(), y.max()], [*lo, *hi], atol=2.5)


def test_gradients_are_those_of_differences(rest: RestModel) -> None:
    stands, own, labels = halves(rest)
    stands.density, own.density = stands.density.clone(), own.density.clone()
    movers = still(own, labels)
    light = Shading.none(own.aabb, 0.0, 1.0, torch.device("cpu"))
    movers.shading = light
    o, d = (x[300:1500:7].contiguous() for x in camera_rays(look_at(np.array([0.3, 2.4, 0.5]))))
    rays = Rays.middle(o, d, 0.5, torch.zeros(len(o), dtype=torch.int64))
    placed = movers.placed(torch.tensor([0.3]))
    grids = stands.density, stands.features, own.density, own.features
    grads = Fields(*(torch.zeros_like(grid) for grid in grids))

    def loss(given: Fields | None = None) -> torch.Tensor:
        return render_layered(stands, movers, placed, rays, given).rgb.sum()

    loss(grads).backward()
    for grid, grad in ((stands.density, grads.density), (own.density, grads.own_density)):
        at = np.unravel_index(int(grad.abs().argmax()), grad.shape)
        step, values = 0.02, []
        for sign in (1, -1):
            grid[at] += sign * step
            values.append(float(loss().detach()))
            grid[at] -= sign * step
        assert float(grad[at]) == pytest.approx((values[0] - values[1]) / (2 * step), rel=0.05)
    assert light.grid.grad is not None
    brighter = float(light.grid.grad.sum())
    with torch.no_grad():
        before = float(loss())
        light.grid.add_(0.01)
        assert float(loss()) - before == pytest.approx(0.01 * brighter, rel=0.05)


@pytest.mark.parametrize("stretch", [None, STRETCH])
def test_corrections_turn_and_shift_parts_between_moments(
    rest: RestModel, stretch: np.ndarray | None
) -> None:
    model = whole(rest, TRAVEL, TURN, stretch)
    assert model.movers is not None
    times = torch.tensor([0.0, 0.2, 0.25, 1.0])
    corrections = Corrections(model.movers, times)
    before, after = model.movers.placed(times), corrections.placed()
    assert torch.allclose(before.rotations, after.rotations, atol=1e-6)
    assert torch.allclose(before.shifts, after.shifts, atol=1e-6)
    with torch.no_grad():
        corrections.values[1, 0, :6] = torch.tensor([0.02, -0.01, 0.03, 0.1, 0.0, -0.05])
        corrections.values[1, 0, 6:] = torch.linspace(-0.02, 0.03, 6 if stretch is not None else 0)
    after, applied = corrections.placed(), corrections.applied(model.movers)
    at_key = applied.placed(torch.tensor([0.5]))
    turned = Rotation.from_rotvec(np.array([0.02, -0.01, 0.03]) / float(corrections.radii[0, 0])).as_matrix()
    expected = turned @ model.movers.rotations[1, 0].numpy()
    assert np.allclose(at_key.rotations[0, 0].numpy(), expected, atol=1e-5)
    middle = corrections.middles[0]
    moved = [p.forth[2, 0] @ middle + p.shifts[2, 0] for p in (before, after)]  # halfway to the moment
    assert np.allclose((moved[1] - moved[0]).detach().numpy(), [0.05, 0.0, -0.025], atol=1e-6)
    assert torch.allclose(after.shifts[[0, 3]], before.shifts[[0, 3]], atol=1e-6)
    more = (applied.stretched() - model.movers.stretched())[:, 0] * corrections.radii[0, 0]
    assert float(more[[0, 2]].abs().max()) == 0 and torch.allclose(more[1], more[1].T)
    if stretch is not None:
        expected = torch.linspace(-0.02, 0.03, 6)
        assert torch.allclose(more[1][torch.triu(torch.ones(3, 3)) > 0], expected, atol=1e-6)
        assert at_key.stretches is not None and torch.allclose(at_key.stretches, applied.stretched()[1:2])


@pytest.mark.parametrize("soft", [False, True])
def test_samples_of_all_layers_are_those_of_each_in_order(
    rest: RestModel, monkeypatch: pytest.MonkeyPatch, soft: bool
) -> None:
    """One launch finds what marching layer by layer finds; where a ray has too many, the nearest stay."""
    stands, movers, o, d, frame = three_layers(rest, soft)
    placed = movers.placed(torch.tensor([0.1, 0.8]))
    asked = stands.volume(), movers.packed(), placed.turned(frame), o, d, 0.5, torch.rand(len(o))
    found, expected = march_layers(*asked), march_layers_ref(*asked)
    assert set(expected.part.tolist()) == {0, 1, 2} and int(expected.offsets.diff().max()) > 10
    # a sample at a border may be inside in one and not in the other
    same = (found.offsets.diff() == expected.offsets.diff()).nonzero()[:, 0]
    assert len(same) > 0.97 * len(o)
    ours, theirs = (
        [x[torch.isin(samples.ray_id, same)] for x in samples[:5]] for samples in (found, expected)
    )
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(layers_module, "MOST", 4)
    nearest = march_layers(*asked)
    assert int(nearest.offsets.diff().max()) == 4
    for r in range(0, len(o), 50):
        few = nearest.t[nearest.offsets[r] : nearest.offsets[r + 1]]
        torch.testing.assert_close(few, found.t[found.offsets[r] : found.offsets[r + 1]][:4])


@pytest.mark.parametrize("soft", [False, True])
def test_rays_composited_in_one_launch_are_those_of_their_samples(
    rest: RestModel, monkeypatch: pytest.MonkeyPatch, soft: bool
) -> None:
    """Sums and all gradients; `alone`: pictures, in which only rays that meet something have a colour."""
    rest = replace(rest, canonical=copy.copy(rest.canonical))
    rest.canonical.deferred = True
    stands, movers, o, d, frame = three_layers(rest, soft)
    grid = torch.randn(Shading.none(stands.aabb, 0.1, 0.7, torch.device("cpu")).grid.shape)
    movers.shading = light = Shading(stands.aabb * 0.8, 0.1, 0.7, 0.3 * grid)
    corrections = Corrections(movers, torch.tensor([0.05, 0.6]))
    rays, by = Rays.middle(o, d, 0.5, frame), torch.randn(len(o), 4)
    grids = stands.density, stands.features, movers.canonical.density, movers.canonical.features

    def seen(warp: bool) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Results, and gradients of all that is trained."""
        monkeypatch.setattr(layered_module, "use_warp", lambda device: warp)
        grads = Fields(*(torch.zeros_like(x) for x in grids))
        found = render_layered(stands, movers, corrections.placed(), rays, grads)
        light.grid.grad = corrections.values.grad = None
        (by * torch.cat([found.rgb, found.left[:, None]], 1)).sum().backward()
        assert light.grid.grad is not None and corrections.values.grad is not None
        return [found.rgb, found.left, found.depth], [*grads, light.grid.grad, corrections.values.grad]

    (ours, our_grads), (theirs, their_grads) = seen(warp=True), seen(warp=False)
    assert float((1 - ours[1].detach()).mean()) > 0.05
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    for a, b in zip(our_grads, their_grads, strict=True):
        assert float(b.norm()) > 0
        assert float((a - b).norm()) < 1e-3 * float(b.norm())
    for warp in (True, False):
        monkeypatch.setattr(layered_module, "use_warp", lambda device, warp=warp: warp)
        alone = draw_layered(stands, movers, corrections.placed(), rays)
        for a, b in zip(alone, ours, strict=True):
            torch.testing.assert_close(a, b.detach(), rtol=1e-3, atol=1e-4)


def three_layers(
    rest: RestModel, soft: bool
) -> tuple[Canonical, Movers, torch.Tensor, torch.Tensor, torch.Tensor]:
    """What stands, two parts that go apart, rays and which of two pictures they are of."""
    stands, own, labels = halves(rest)
    places = vertices(own.aabb, own.shape)
    movers = still(own, torch.where((labels > 0) & (places[..., 2] > 0), 2, labels).to(torch.uint8), 2)
    movers.shifts[1:, 1] = torch.tensor([0.1, -0.2, 0.1])
    movers.rotations[2, 0] = torch.from_numpy(Rotation.from_rotvec(TURN).as_matrix()).float()
    if soft:
        movers.stretches = torch.from_numpy(STRETCH).float().expand(3, 2, 3, 3)
    o, d = (x[::3].contiguous() for x in camera_rays(look_at(np.array([0.3, 2.4, 0.5]))))
    return stands, movers, o, d, torch.arange(len(o)) % 2


@pytest.mark.parametrize("soft", [False, True])
def test_gradients_of_corrections_are_those_of_differences(
    rest: RestModel, monkeypatch: pytest.MonkeyPatch, soft: bool
) -> None:
    stands, own, labels = halves(rest)
    movers = still(own, labels)
    if soft:
        movers.stretches = torch.from_numpy(STRETCH).float().expand(3, 1, 3, 3)
    corrections = Corrections(movers, torch.tensor([0.4]))
    o, d = (x[300:1500:7].contiguous() for x in camera_rays(look_at(np.array([0.3, 2.4, 0.5]))))
    frame, middle = torch.zeros(len(o), dtype=torch.int64), torch.full((len(o),), 0.5)
    wanted = torch.linspace(0, 1, len(o))[:, None]
    turned = movers.placed(torch.tensor([0.4])).turned(frame)
    samples = march_layers(stands.volume(), movers.packed(), turned, o, d, 0.5, middle)
    monkeypatch.setattr(layered_module, "march_layers", lambda *arguments: samples)  # it has no gradient

    def loss() -> torch.Tensor:
        rays = Rays(o, d, 0.5, middle, frame)
        seen = render_layered(stands, movers, corrections.placed(), rays)
        return (wanted * seen.rgb).sum()

    loss().backward()
    assert corrections.values.grad is not None
    differences = np.zeros(12 if soft else 6)
    for n in range(len(differences)):
        values = []
        for sign in (1, -1):
            corrections.values.data[1, 0, n] += sign * 1e-3
            values.append(float(loss().detach()))
            corrections.values.data[1, 0, n] -= sign * 1e-3
        differences[n] = (values[0] - values[1]) / 2e-3
    found = corrections.values.grad[1, 0].numpy()
    assert found @ differences > 0.95 * np.linalg.norm(found) * np.linalg.norm(differences)
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(differences), rel=0.2)


@pytest.mark.full
def test_training_corrects_where_parts_are(session: Scene, rest: RestModel) -> None:
    model = whole(rest, TRAVEL)
    assert model.movers is not None and model.in_motion is not None
    off = torch.tensor([0.0, 1.5 * rest.canonical.voxel, 0.0])
    shifts = model.movers.shifts.clone()
    shifts[1:] += off
    wrong = replace(model.movers, shifts=shifts)
    pictures = MovingPictures(session, rest, "cpu")
    trained = train_movers(pictures, model.in_motion.canonical, wrong, replace(OPTIONS, together=100))
    left = (trained.movers.shifts - model.movers.shifts)[1:].norm(dim=-1)
    assert float(left.mean()) < 0.6 * float(off.norm())


def test_shading_is_linear_between_its_vertices_and_keeps_to_its_layer() -> None:
    aabb = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    light = Shading.none(aabb, 0.2, 0.8, torch.device("cpu"))
    times = torch.linspace(0.2, 0.8, light.grid.shape[1])
    axes = [torch.linspace(-1, 1, n) for n in light.grid.shape[2:]]
    t, x, y, z = torch.meshgrid(times, *axes, indexing="ij")
    with torch.no_grad():
        light.grid[0] = 2 * t + x - 3 * y + 0.5 * z
    points = torch.rand(50, 3) * 2 - 1
    time = torch.rand(50) * 0.6 + 0.2
    expected = 2 * time + points @ torch.tensor([1.0, -3.0, 0.5])
    assert torch.allclose(light.at(torch.zeros(50, dtype=torch.int64), points, time), expected, atol=1e-4)
    assert float(light.at(torch.ones(50, dtype=torch.int64), points, time).detach().abs().max()) == 0
    flat = Shading.none(aabb, 0.0, 1.0, torch.device("cpu"))
    assert float(flat.penalty().detach()) == 0 < float(light.penalty().detach())


@pytest.mark.parametrize("soft", [False, True])
def test_a_file_holds_the_model(rest: RestModel, tmp_path: Path, soft: bool) -> None:
    stands, own, labels = halves(rest)
    stands.density[labels == 1] = 0.5  # filled where the mover stood
    stands.rebuild_occupancy()
    movers = still(own, labels)
    movers.shifts[1:, 0, 2] = torch.tensor([0.1, 0.25])
    if soft:
        movers.stretches = torch.from_numpy(STRETCH).float().expand(3, 1, 3, 3)
    light = Shading.none(own.aabb, 0.0, 1.0, torch.device("cpu"))
    with torch.no_grad():
        light.grid.add_(torch.linspace(-0.3, 0.3, light.grid.shape[2])[:, None, None])
    light.requires_grad_(False)
    model = DynamicModel.of_movers(
        rest, replace(rest, canonical=stands), replace(movers, shading=light), 3, 0.0
    )
    (path,) = save_deformation(tmp_path, model)
    again = load_deformation(tmp_path, rest)
    assert again.movers is not None and torch.equal(again.movers.labels, labels)
    assert torch.equal(again.movers.stretched(), movers.stretched())
    camera = look_at(np.array([1.5, 2.0, 0.7]))
    for time in (0.0, 0.7):
        assert np.abs(render_view(model, camera, time) - render_view(again, camera, time)).max() < 0.02
    constant, plain = model.unshaded(), DynamicModel.of_movers(rest, model.in_motion or rest, movers, 3, 0.0)
    assert constant is not None and plain.unshaded() is None
    assert np.array_equal(render_view(constant, camera, 0.7), render_view(plain, camera, 0.7))
    assert np.abs(render_view(constant, camera, 0.7) - render_view(model, camera, 0.7)).max() > 0.02
    save_rest(tmp_path / "rest.safetensors", rest)
    assert (
        path.stat().st_size < 1.5 * (tmp_path / "rest.safetensors").stat().st_size
    )  # half moves, half is filled


@pytest.mark.parametrize("stretch", [np.eye(3), STRETCH])
def test_points_are_carried_and_brought_back(rest: RestModel, stretch: np.ndarray) -> None:
    model = whole(rest, TRAVEL, TURN, stretch)
    R = Rotation.from_rotvec(TURN).as_matrix() @ stretch
    on_ball = RADIUS * np.array([[1.0, 0, 0], [0, 0.6, 0.8], [-0.6, 0.8, 0]])
    there = on_ball @ R.T + TRAVEL
    assert np.allclose(moved(model, on_ball, None, 1.0), there, atol=1e-5)
    assert np.allclose(moved(model, there, 1.0, None), on_ball, atol=1e-5)
    far = np.array([[0.95, 0.95, 0.95]])
    assert np.allclose(moved(model, far, None, 1.0), far)
    field = field_at(model, 1.0)
    x = torch.from_numpy(there).float()
    assert torch.allclose(
        field.density(x), field_at(model, None).density(torch.from_numpy(on_ball).float()), rtol=1e-3
    )
    assert torch.allclose(field.to_rest(x), torch.from_numpy(on_ball).float(), atol=1e-5)
    assert torch.allclose(field.from_rest(field.to_rest(x)), x, atol=1e-5)


def test_the_motion_field_is_the_parts_motion(rest: RestModel) -> None:
    motion = whole(rest, TRAVEL).motion
    assert motion is not None and motion.rest_key == 0
    assert float(motion.forward[0].abs().max()) == 0
    on_ball = RADIUS * torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [-0.6, 0.8, 0]])
    way, last = torch.from_numpy(TRAVEL).float(), torch.full((3,), 4.0)
    assert torch.allclose(motion.from_rest(on_ball, last), on_ball + way, atol=0.02)
    assert torch.allclose(motion.to_rest(on_ball + way, last), on_ball, atol=0.02)
    assert (motion.aabb[1, [0, 2]] > rest.canonical.aabb[1, [0, 2]]).all()


@pytest.fixture(scope="module")
def session(ball: Ball, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return ball_clips(ball, tmp_path_factory.mktemp("clips"), TIMES, TRAVEL)


def test_training_together_gains_over_nothing_moves(session: Scene, rest: RestModel) -> None:
    model = whole(rest, TRAVEL)
    assert model.movers is not None and model.in_motion is not None
    before = model.movers.canonical.density.clone()
    pictures = MovingPictures(session, rest, "cpu")
    trained = train_movers(pictures, model.in_motion.canonical, model.movers, OPTIONS)
    assert trained.errors.gain_db(trained.errors_at_rest) > 5
    assert trained.unshaded_errors.gain_db(trained.errors_at_rest) > 5
    assert torch.equal(model.movers.canonical.density, before)  # nobody else's is changed
    assert not torch.equal(trained.movers.canonical.density, before)
    assert trained.movers.shading is not None and not trained.movers.shading.grid.requires_grad


def test_pictures_of_a_test_camera_are_not_among_those_that_movers_learn_from(
    session: Scene, rest: RestModel
) -> None:
    tested = session.dynamic[0].camera_name
    dynamic = [replace(f, split="test") if f.camera_name == tested else f for f in session.dynamic]
    frames = MovingPictures(replace(session, dynamic=tuple(dynamic)), rest, "cpu").rays.frames
    assert frames and tested not in {frame.camera_name for frame in frames}


@pytest.mark.parametrize(
    ("seconds", "iterations", "keys"), [(2.0, 30, 14), (3.0, 30, 14), (12.0, 120, 53), (600.0, 240, 105)]
)
def test_what_moves_for_longer_is_trained_for_longer_and_has_more_moments_of_shading(
    session: Scene, rest: RestModel, seconds: float, iterations: int, keys: int
) -> None:
    stands, own, labels = halves(rest)
    scene = replace(session, t0_s=1.0, t1_s=1.0 + seconds)
    training = _Recipe(MovingPictures(scene, rest, "cpu"), stands, still(own, labels), OPTIONS, {})
    assert training.iterations == iterations and training.shading.grid.shape[1] == keys


@pytest.mark.full
def test_killed_it_goes_on_bit_for_bit(
    session: Scene, rest: RestModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_movers_module, "OCCUPANCY_EVERY", 3)
    model = whole(rest, TRAVEL)
    assert model.movers is not None and model.in_motion is not None
    stands, movers = model.in_motion.canonical, model.movers
    options, pictures = replace(OPTIONS, together=8), MovingPictures(session, rest, "cpu")

    def train(state):
        return train_movers(pictures, stands, movers, options, run=TrainingRun(checkpoint=state))

    once = train_movers(pictures, stands, movers, options)
    again = until_done(train, tmp_path, {("", done) for done in (3, 6)})
    assert torch.equal(once.movers.canonical.density, again.movers.canonical.density)
    assert torch.equal(once.stands.canonical.features, again.stands.canonical.features)
    assert once.movers.shading is not None and again.movers.shading is not None
    assert torch.equal(once.movers.shading.grid, again.movers.shading.grid)
    assert torch.equal(once.movers.shifts, again.movers.shifts)
    assert not torch.equal(once.movers.shifts, movers.shifts)  # they were corrected


@pytest.fixture
def tracked(rest: RestModel, monkeypatch: pytest.MonkeyPatch):
    """What `find_movers` finds is decided by the test: the whole ball, how far it goes until time 1, and why."""

    def found(travel: np.ndarray, offsets_s: dict[str, float]) -> TrackedParts:
        model = whole(rest, travel)
        assert model.movers is not None and model.in_motion is not None
        times = np.array([0.0, 0.5, 1.0])
        xyz = RADIUS * np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
        tracks = SurfaceTracks(
            times, xyz + times[:, None, None] * travel, np.zeros((3, 3), bool), np.zeros(2)
        )
        surface = SurfacePoints(xyz, xyz / RADIUS, np.ones_like(xyz), 0.1)
        stands = model.in_motion.canonical
        return TrackedParts(surface, tracks, np.zeros(3, int), stands, model.movers, offsets_s)

    def decide(
        travel: np.ndarray, offsets_s: dict[str, float] | None = None, decisions: Sequence[Decision] = ()
    ) -> TrackedParts:
        one = found(travel, offsets_s or {})
        monkeypatch.setattr(
            "devrf.reconstruct.training.moving_parts.why_not_tracked", lambda scene, rest: None
        )
        monkeypatch.setattr(
            "devrf.reconstruct.training.moving_parts.find_movers", lambda *arguments: (one, [*decisions])
        )
        return one

    return decide


def alone(scene: Scene) -> Scene:
    """With one training camera."""
    return replace(scene, dynamic=tuple(f for f in scene.dynamic if f.camera_name == "cam0"))


@pytest.mark.parametrize(
    ("scene_is", "ndc", "word"),
    [
        (alone, None, "more: 1, at least 2"),
        (lambda scene: replace(scene, rest_time=None), None, "at rest"),
        (lambda scene: replace(scene, background="white"), None, "plain"),
        (lambda scene: scene, Ndc(1.0, 1.0), "forward-facing"),
    ],
)
def test_why_nothing_is_tracked_is_said(
    session: Scene,
    rest: RestModel,
    monkeypatch: pytest.MonkeyPatch,
    scene_is: Callable[[Scene], Scene],
    ndc: Ndc | None,
    word: str,
) -> None:
    scene = replace(session, background="shell")
    assert why_not_tracked(scene, rest) is None
    rest = replace(rest, canonical=copy.copy(rest.canonical))
    rest.canonical.ndc = ndc
    monkeypatch.setattr(
        "devrf.reconstruct.recipe.motion_field",
        lambda *arguments: (DynamicModel(rest), {"decisions": []}),
    )
    (decision,) = recipe.motion(scene_is(scene), rest, {}, OPTIONS, estimator=DisFlow)[1]["decisions"]
    assert decision.startswith("movers: none instead of tracked") and word in decision
    _, metrics = recipe.motion(scene_is(scene), rest, {}, PRESETS["reference"].motion, estimator=DisFlow)
    assert metrics["decisions"] == []


def half_covered() -> tuple[SurfacePoints, SurfaceTracks, np.ndarray]:
    """A ball goes along a line; half of it is covered from the third moment of five, and guessed to stay."""
    ball = np.random.default_rng(0).normal(size=(300, 3))
    ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    surface = SurfacePoints(ball, ball / RADIUS, np.ones_like(ball), 0.2 * RADIUS)
    way = np.linspace(0, 1, 5)[:, None, None] * TRAVEL
    xyz, lost = ball + way, np.zeros((5, 300), dtype=bool)
    lost[2:, ball[:, 0] > 0] = True
    xyz[lost] = np.broadcast_to(ball + way[1], xyz.shape)[lost]
    return surface, SurfaceTracks(np.linspace(0, 1, 5), xyz, lost, np.zeros(2)), way[:, 0]


def test_points_that_are_lost_after_a_while_go_with_their_part(session: Scene, rest: RestModel) -> None:
    surface, tracks, way = half_covered()
    scene = session.in_box_frame()
    tracks = replace(tracks, offsets=np.zeros(len(standing_clips(scene))))
    hidden = torch.zeros(rest.canonical.shape, dtype=torch.bool)
    everything = np.ones(300, dtype=bool)
    found = parts_of(scene, rest, AtRest(surface, hidden), everything, Graph(surface), tracks)
    assert found is not None and found.movers.parts == 1
    assert np.allclose(found.movers.shifts[:, 0], way, atol=1e-5)
    (told,) = found.told(np.eye(4))
    assert told["longest_lost"] == 3


def test_what_appears_in_empty_air_is_not_tracked(session: Scene, rest: RestModel) -> None:
    nothing = torch.zeros(rest.canonical.shape, dtype=torch.bool)
    empty = replace(rest, canonical=rest.canonical.only(nothing))
    assert find_movers(session.in_box_frame(), empty, DisFlow()) == (None, [])


def test_movers_are_taken_where_they_explain_the_pictures(session: Scene, rest: RestModel, tracked) -> None:
    tracked(TRAVEL)
    model, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    assert model.movers is not None and model.in_motion is not None and model.motion is not None
    assert metrics["parts"] == 1 and metrics["points"] == 3 and metrics["keys"] == 3
    assert metrics["largest_motion"] == pytest.approx(np.linalg.norm(TRAVEL))
    assert metrics["movers_gain_db"] > 5
    (decision,) = metrics["decisions"]
    assert decision.startswith("parts: rigid instead of soft")
    assert [row.verdict for row in judge(mover_measures(metrics))] == ["ok"]
    assert metrics["rigid_parts"][0]["longest_lost"] == 0 and metrics["lost_share"] == 0
    assert metrics["clock_offsets_s"] == {}
    still, field, movers = (
        errors_in_motion(MovingPictures(session.in_box_frame(), one.rest, "cpu"), one)
        for one in (whole(rest, 0 * TRAVEL), DynamicModel(rest, model.motion), model)
    )
    assert 3 < field.gain_db(still) < movers.gain_db(still)  # what stood behind is not in the field


def errors(by_db: float, spread_db: float = 0.0) -> Errors:
    """Of a camera's pictures, smaller by so many dB than those of others, with a spread over time."""
    n = np.arange(4 * TIMES)
    db = 20 + by_db + spread_db * np.sin(2 * np.pi * n / len(n))
    return Errors(tuple(("cam0", int(at)) for at in n), n / len(n), 10 ** (-db / 10), np.ones(len(n), int))


def test_clocks_are_those_of_tracking(session: Scene, rest: RestModel, tracked) -> None:
    moved = Decision("clocks", "cam1 +20 ms", "as they are", "because")
    tracked(TRAVEL, {"cam1": 0.02}, [moved])
    _, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    assert metrics["decisions"][0] == str(moved) and metrics["clock_offsets_s"] == {"cam1": 0.02}


@pytest.mark.parametrize("stretch", [np.eye(3), STRETCH])
def test_parts_are_soft_where_that_explains_more_than_chance(
    ball: Ball,
    rest: RestModel,
    tracked,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stretch: np.ndarray,
) -> None:
    """The tracks of points of the ball are good to a voxel."""
    rng, soft = np.random.default_rng(0), bool((stretch != np.eye(3)).any())
    xyz = rng.normal(size=(300, 3))
    xyz *= RADIUS / np.linalg.norm(xyz, axis=1, keepdims=True)
    found = tracked(TRAVEL)
    times = found.tracks.times[:, None, None]
    way = times * TRAVEL + xyz + times * (xyz @ stretch - xyz)
    way[1:] += rng.normal(0, 0.5 * rest.canonical.voxel, way[1:].shape)
    tracks = replace(found.tracks, xyz=way, lost=np.zeros(way.shape[:2], bool))
    surface = SurfacePoints(xyz, xyz / RADIUS, np.ones_like(xyz), 0.1)
    found = replace(found, surface=surface, tracks=tracks, labels=np.zeros(len(xyz), int))
    monkeypatch.setattr("devrf.reconstruct.training.moving_parts.find_movers", lambda *arguments: (found, []))
    session = ball_clips(ball, tmp_path, 2 * TIMES + 1, TRAVEL, stretch)
    model, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    assert model.movers is not None
    (decision,) = metrics["decisions"]
    assert decision.startswith("parts: soft instead of rigid" if soft else "parts: rigid instead of soft")
    found_stretch = model.movers.stretched()[-1, 0].numpy()
    assert np.abs(found_stretch - stretch).max() < (0.05 if soft else 1e-6)


def test_what_moves_as_found_has_a_smaller_error_before_training(
    session: Scene, rest: RestModel, tracked
) -> None:
    found, away = tracked(TRAVEL), tracked(-TRAVEL)
    motions, boxed = [found.movers, away.movers], session.in_box_frame()
    right, wrong = untrained_errors(MovingPictures(boxed, rest, "cpu"), found.stands, motions, OPTIONS)
    assert 0 < right.mean < wrong.mean / 2 and right.gain_over(wrong).side() > 0


def test_pixels_left_out_are_the_same_with_other_clocks(session: Scene, rest: RestModel, tracked) -> None:
    """The last two pictures of cam1 are beyond the modelled time then."""
    found = tracked(TRAVEL)
    scene = replace(session.in_box_frame(), t0_s=0.0, t1_s=1.0)
    options, offset_s = replace(OPTIONS, together=1), 1.5 / (TIMES - 1)
    parts, pictures = (found.stands, found.movers, options), MovingPictures(scene, rest, "cpu")
    as_it_is = train_movers(pictures, *parts)
    moved = train_movers(pictures, *parts, offsets_s={"cam1": offset_s})
    gone = set(as_it_is.errors.pictures) - set(moved.errors.pictures)
    assert gone == {("cam1", TIMES - 2), ("cam1", TIMES - 1)}
    pixels = dict(zip(as_it_is.errors.pictures, as_it_is.errors.pixels.tolist(), strict=True))
    at_rest = dict(zip(as_it_is.errors.pictures, as_it_is.errors_at_rest.mse.tolist(), strict=True))
    for picture, count, mse in zip(
        moved.errors.pictures, moved.errors.pixels.tolist(), moved.errors_at_rest.mse.tolist(), strict=True
    ):
        assert pixels[picture] == count and at_rest[picture] == mse  # bit for bit


@pytest.mark.parametrize(
    ("parts_db", "field"),
    [
        (DOUBTED_DB + 0.01, None),
        (2.0, errors(-0.1)),
        (2.0, errors(0.1)),
        (2.0, errors(0.5, 2.0)),
        (-0.1, errors(0.5, 2.0)),  # as if nothing moved
    ],
)
def test_a_field_is_trained_too_where_movers_explain_little(
    session: Scene,
    rest: RestModel,
    tracked,
    monkeypatch: pytest.MonkeyPatch,
    parts_db: float,
    field: Errors | None,
) -> None:
    tracked(TRAVEL)
    model, module = whole(rest, TRAVEL), "devrf.reconstruct.training.moving_parts."
    assert model.movers is not None and model.in_motion is not None
    trained = TrainedParts(model.in_motion, model.movers, errors(1), errors(0), errors(-parts_db), COST)
    asked, learn = (
        Mock(return_value=field),
        Mock(return_value=(DynamicModel(rest), {**COST, "decisions": []})),
    )
    monkeypatch.setattr(module + "train_movers", lambda *_: trained)
    monkeypatch.setattr("devrf.reconstruct.recipe.motion_field", learn)
    monkeypatch.setattr("devrf.reconstruct.recipe.errors_in_motion", asked)
    found, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    if field is None:
        assert found.movers is not None and not learn.called and metrics["iterations"] == 5
        return
    gain = field.gain_over(errors(0))
    better = gain.side() > 0 or parts_db < 0
    assert (found.movers is None) == better and metrics["iterations"] == 10
    said = metrics["decisions"][-1]
    assert said.startswith(f"movers: {'none instead of 1 parts' if better else '1 parts instead of a field'}")
    assert f"{gain.mean:+.2f} ± {gain.half:.2f} dB" in said


@pytest.mark.parametrize("one_camera", [False, True])
@pytest.mark.parametrize("competes", [True, False])
def test_a_field_that_competes_leaves_out_what_movers_leave_out(
    session: Scene,
    rest: RestModel,
    tracked,
    monkeypatch: pytest.MonkeyPatch,
    competes: bool,
    one_camera: bool,
) -> None:
    """Every ray that its training draws, those by which it is seen whether a key became worse too."""
    drawn: list[torch.Tensor] = []

    class Spy(train_motion_module.PixelSurroundings):
        def at(self, frame: torch.Tensor, pixel: torch.Tensor):
            drawn.append(left_out(frame, pixel))
            return super().at(frame, pixel)

    tracked(-TRAVEL)
    monkeypatch.setattr(train_motion_module, "PixelSurroundings", Spy)
    options = replace(OPTIONS, iterations=(4,), together=1, one_camera=one_camera, rays=256)
    recipe.motion(session, rest, {}, options, estimator=DisFlow if competes else None)
    assert len(drawn) > 8 and any(bool(rays.any()) for rays in drawn) == (not competes)


@pytest.mark.full
def test_movers_that_explain_nothing_give_way_to_a_field(session: Scene, rest: RestModel, tracked) -> None:
    tracked(-TRAVEL)  # the other way
    model, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    assert model.movers is None and model.motion is not None
    assert len(metrics["decisions"]) == 1 and "movers" in metrics["decisions"][0]
    assert list(mover_measures(metrics)) == []


@pytest.mark.parametrize("preset", ["tiny", "fast", "reference"])
def test_a_scene_in_which_nothing_moves_costs_nothing(
    ball: Ball, rest: RestModel, tmp_path: Path, preset: str
) -> None:
    scene = ball_clips(ball, tmp_path, 5, 0 * TRAVEL)
    small = {"levels": (4,), "iterations": (2,), "rays": 64, "keys": 3}
    options = replace(PRESETS[preset].motion, **small)
    model, metrics = recipe.motion(scene, rest, {}, options)
    said = [line for line in metrics["decisions"] if line.startswith("key times to train: none instead of 2")]
    if preset == "reference":
        assert metrics["iterations"] == 4 and not metrics["decisions"]
        return
    assert metrics["iterations"] == 0 and metrics["decisions"] == said and len(said) == 1
    assert model.in_motion is None and "fine_tuning_s" not in metrics
    assert model.motion is not None and metrics["largest_motion"] == 0
    assert float(model.motion.backward.abs().max()) == 0


def test_moved_clocks_are_said() -> None:
    assert moved_clock_measures({}) == []
    (row,) = judge(moved_clock_measures({"cam1": 0.004, "cam2": -0.057}))
    assert row.verdict == "warn" and row.value == pytest.approx(57)
    assert "cam1 +4 ms, cam2 -57 ms" in row.remedy and "lag of cam2" in row.remedy
    (row,) = judge(moved_clock_measures({"cam1": 0.004}))
    assert (row.verdict, row.about) == ("ok", "cam1")


def test_a_part_that_is_lost_is_said(rest: RestModel) -> None:
    model = whole(rest, TRAVEL)
    assert model.movers is not None and model.in_motion is not None
    lost = np.zeros((8, 4), bool)
    lost[1, :3] = lost[3:6, :3] = lost[6:, 0] = True  # one moment, three in a row; then hardly anything
    xyz = np.eye(4, 3)
    tracks = SurfaceTracks(np.linspace(0, 1, 8), np.tile(xyz, (8, 1, 1)), lost, np.zeros(2))
    surface = SurfacePoints(xyz, xyz, xyz, 0.1)
    found = TrackedParts(surface, tracks, np.zeros(4, int), model.in_motion.canonical, model.movers, {})
    box_from_world = np.diag([0.5, 0.5, 0.5, 1.0])
    (told,) = found.told(box_from_world)
    assert told == {"part": 1, "at": [0.5, 0.5, 0.5], "points": 4, "goes": 0.0, "longest_lost": 3}
    parts = [{**told, "longest_lost": 1}, {**told, "at": [0.1, 0.25, -1.0]}]
    (row,) = judge(mover_measures({"movers_gain_db": 4.0, "rigid_parts": parts}))
    assert row.verdict == "warn" and row.value == 3 and "(0.10, 0.25, -1.00)" in row.remedy


def test_movers_whose_training_diverges_give_way_to_a_field(
    session: Scene, rest: RestModel, tracked, monkeypatch: pytest.MonkeyPatch
) -> None:
    def runs_away(*arguments: object) -> None:
        raise diverged("the loss")

    tracked(TRAVEL)
    monkeypatch.setattr("devrf.reconstruct.training.moving_parts.train_movers", runs_away)
    model, metrics = recipe.motion(session, rest, {}, OPTIONS, estimator=DisFlow)
    assert model.movers is None and "training diverged" in metrics["decisions"][0]
