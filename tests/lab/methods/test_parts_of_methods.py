"""Special parts of the methods against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.linalg import expm

from devrf.lab.methods.d_nerf import DNerf
from devrf.lab.methods.field import FieldPoints, FieldTraining, Settings, drawn_again, quadrature
from devrf.lab.methods.hyper_nerf import HyperNerf
from devrf.lab.methods.nerfies import Nerfies, elastic, moved
from devrf.lab.methods.networks import Codes, Encoding, window
from devrf.lab.methods.neural_volumes import NeuralVolumes
from devrf.lab.methods.nsff import CYCLE, STEP, SceneFlow
from devrf.lab.methods.pictures import Space, TaskPictures
from devrf.lab.methods.planes import IN_TIME, Planes

MOMENTS = torch.linspace(0, 1, 5)


def some_points(n: int = 64, rest: float = 0.0) -> FieldPoints:
    """Points anywhere in the box at any time."""
    generator = torch.Generator().manual_seed(3)
    x = 2 * torch.rand(n, 3, generator=generator) - 1
    d = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    return FieldPoints(x, d, torch.rand(n, generator=generator), torch.full((n,), rest))


def at(points: FieldPoints, **changes: torch.Tensor) -> FieldPoints:
    """The same with other values."""
    return FieldPoints(**(vars(points) | changes))


def test_a_screw_is_the_exponential_of_its_twist():
    screw = torch.tensor([[0.3, -1.1, 0.7, 0.2, 0.5, -0.4], [1e-7, 0, 0, 1.0, 2.0, 3.0]])
    x = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    for found, twist, point in zip(moved(x, screw), screw.double(), x.double(), strict=True):
        r, v = twist[:3], twist[3:]
        cross = torch.tensor([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
        true = torch.from_numpy(
            expm(torch.cat([torch.cat([cross, v[:, None]], 1), torch.zeros(1, 4)]).numpy())
        )
        torch.testing.assert_close(found.double(), true[:3, :3] @ point + true[:3, 3], atol=1e-5, rtol=1e-5)


def test_elastic_is_nothing_for_rotations_and_something_for_stretches():
    turn = torch.linalg.qr(torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0)))[0]
    assert float(elastic(turn).max()) < 1e-5
    little, much = elastic(torch.diag(torch.tensor([1.01, 1, 1]))[None]), elastic(2 * torch.eye(3)[None])
    assert 0.01 < float(little) < float(much) < 2


def test_the_window_opens_frequency_by_frequency():
    assert window(0.0, 4).tolist() == [0, 0, 0, 0] and window(4.0, 4).tolist() == pytest.approx([1, 1, 1, 1])
    assert window(1.5, 3).tolist() == pytest.approx([1, 0.5, 0])
    encoding = Encoding(1, 2)
    encoding.alpha = 1.0
    out = encoding(torch.tensor([[0.25]]))[0].tolist()
    half = math.sqrt(0.5)
    assert out == pytest.approx([0.25, half, 0, half, 0], abs=1e-6)


def test_codes_are_linear_between_moments():
    codes = Codes(MOMENTS, 2)
    middle = codes(torch.tensor([0.125]))[0]
    torch.testing.assert_close(middle, (codes.table[0] + codes.table[1]) / 2)
    torch.testing.assert_close(codes(torch.tensor([2.0]))[0], codes.table[-1])


def test_even_density_hides_as_much_as_its_length_says():
    t = torch.linspace(0, 2, 65)[None, :-1]
    weights = quadrature(torch.full((1, 64), 0.7), t, torch.tensor([2.0]))
    assert float(weights.sum()) == pytest.approx(1 - math.exp(-1.4), abs=1e-5)


def test_samples_are_drawn_where_weights_are():
    steps = (torch.arange(8) + 0.5)[None] / 8
    weights = torch.zeros(1, 8)
    weights[0, 5] = 1
    again = drawn_again(steps, weights, 100, torch.Generator().manual_seed(0))
    assert float(((again >= 5 / 8) & (again <= 6 / 8)).float().mean()) > 0.9
    even = drawn_again(steps, torch.ones(1, 8), 4, None)
    torch.testing.assert_close(even, (torch.arange(4) + 0.5)[None] / 4)


@pytest.mark.parametrize("behind", [None, torch.ones(3)], ids=["surroundings", "plain"])
def test_space_is_contracted_and_expanded_again(behind):
    space = Space(torch.tensor([-1.0, -0.5, -0.7]), torch.tensor([1.0, 0.5, 0.7]), 0.1, behind)
    x = torch.tensor([[0.2, -0.3, 0.5], [0.9, 0.1, 0.0], [4.0, -2.0, 1.0], [50.0, 3.0, -20.0]])
    x = x if space.surrounded else x[:2]
    y = space.contracted(x)
    assert float(y.abs().max()) <= 1
    torch.testing.assert_close(space.expanded(y), x, rtol=1e-3, atol=1e-4)


def test_steps_along_a_ray_rise_to_what_is_far():
    space = Space(-torch.ones(3), torch.ones(3), 0.1, None)
    o, d = torch.tensor([[-3.0, 0, 0]]), torch.tensor([[1.0, 0, 0]])
    t = space.distances(o, d, torch.linspace(0, 1, 101)[None])[0]
    assert (
        bool((t.diff() > 0).all()) and float(t[0]) == pytest.approx(0.1) and float(t[50]) == pytest.approx(4)
    )
    assert float(t[-1]) == pytest.approx(1000, rel=1e-4)
    plain = Space(-torch.ones(3), torch.ones(3), 0.1, torch.ones(3)).distances(
        o, d, torch.tensor([[0.0, 1.0]])
    )
    assert plain[0].tolist() == pytest.approx([2, 4])


@pytest.mark.parametrize("make", [DNerf, Nerfies, HyperNerf])
def test_what_is_at_rest_does_not_depend_on_time(make):
    torch.manual_seed(0)
    field = make("small") if make is DNerf else make("small", MOMENTS)
    for parameter in field.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    still = some_points(rest=1.0)
    later = at(still, time=torch.rand(64))
    torch.testing.assert_close(field(still).rgb, field(later).rgb)
    moving = some_points()
    assert (field(moving).density - field(at(moving, time=1 - moving.time)).density).abs().max().item() > 1e-4


def test_the_slice_decides_what_the_template_shows():
    torch.manual_seed(0)
    field, points = HyperNerf("small", MOMENTS), some_points()
    torch.nn.init.constant_(field.slice.out.bias, 0.0)
    torch.nn.init.zeros_(field.slice.out.weight)
    flat = field(points).density
    torch.nn.init.constant_(field.slice.out.bias, 0.4)
    assert (field(points).density - flat).abs().max().item() > 1e-4
    still = some_points(rest=1.0)
    torch.nn.init.constant_(field.slice.out.bias, 0.0)
    before = field(still).density
    torch.nn.init.constant_(field.slice.out.bias, 0.4)
    torch.testing.assert_close(field(still).density, before)


def test_flow_there_and_back_costs_nothing(task):
    torch.manual_seed(0)
    pictures = TaskPictures(task())
    field = SceneFlow("small", pictures.moments)
    torch.nn.init.zeros_(field.flow.weight)
    training = FieldTraining(task(), field, pictures, Settings(6, (10, 0), 1e-3, 1e-3))
    training.space = replace(training.space, hull=None)  # of every sample
    rays = pictures.draw(6, training.generator, 0.0)
    step = torch.tensor([0.1, 0.0, 0.2])

    def cycle(forward: torch.Tensor, backward: torch.Tensor) -> float:
        with torch.no_grad():
            field.flow.bias[:6] = torch.cat([forward, backward])
        found = field.losses(training, rays, training.rendered(rays, jitter=False))
        return (found["cycle0"] + found["cycle1"]).item()

    assert cycle(step, -step) == pytest.approx(0, abs=1e-6)
    off = 2 * STEP * float(torch.tanh(step).abs().sum())
    visible = 1 / (1 + math.exp(-2))
    there = [rays.time + sign * field.gap for sign in (1, -1)]
    inside = sum(float(((t > -1e-3) & (t < 1 + 1e-3)).float().mean()) for t in there)
    assert inside > 0 and cycle(step, step) == pytest.approx(CYCLE * visible * off * inside, rel=1e-4)


def test_a_mixture_of_one_motion_is_that_motion():
    torch.manual_seed(0)
    field, points = NeuralVolumes("small", MOMENTS), some_points(rest=1.0)
    motion = torch.tensor([[0.9, 0.1, 0, 0.02], [-0.1, 0.9, 0, 0.0], [0, 0, 1, -0.01]])
    with torch.no_grad():
        field.affine.weight.zero_()
        field.affine.bias.copy_(motion.expand(field.warps, 3, 4).reshape(-1))
    x = 0.5 * points.x
    torch.testing.assert_close(field.warped(x, field.rest_code), x @ motion[:, :3].T + motion[:, 3])


def test_opacity_of_neural_volumes_adds_up_to_one():
    field = NeuralVolumes("small", MOMENTS)
    t = torch.linspace(0, 1, 11)[None, :-1]
    weights = field.weights(torch.full((1, 10), 4.0), t, torch.tensor([1.0]))
    assert weights[0].tolist() == pytest.approx([0.4, 0.4, 0.2] + [0] * 7, abs=1e-5)


@pytest.mark.parametrize("hex_plane", [True, False])
def test_planes_of_ones_in_time_are_a_scene_at_rest(hex_plane):
    torch.manual_seed(0)
    field, points = Planes("small", MOMENTS, 0.0, hex_plane), some_points()
    same = field(at(points, time=1 - points.time))
    torch.testing.assert_close(field(points).density, same.density)
    changes = field.regularised()
    assert changes["changes"].item() == changes["jerks"].item() == 0 < changes["variation"].item()
    with torch.no_grad():
        for planes in field.levels():
            for n in IN_TIME:
                planes[n].add_(0.5 * torch.rand_like(planes[n]))
    assert (field(points).density - field(at(points, time=1 - points.time)).density).abs().max().item() > 1e-4
