"""Splats: the rasteriser against its reference, what they look like, how they are packed, and of a known model."""

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.make.models import (
    BALL,
    COLOUR,
    RADIUS,
    REST,
    SLAB,
    STICK,
    TRAVEL,
    motion_at,
    moving_ball,
    moving_parts,
    outside,
)
from tests.make.scenes import scene_of
from tests.reconstruct.conftest import around, look_at

from devrf.capture.camera import Camera
from devrf.capture.formats.geometry.ply import GaussianVertices, write_splat_ply
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.kernels.splat import FAINT, splat, splat_ref
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.splats.fit import FINEST_PX, fit
from devrf.reconstruct.splats.gaussians import (
    BLUR,
    Gaussians,
    flattened,
    pixel_sizes,
    quats_of,
    rotations,
    tiles_of,
    transformed,
)
from devrf.reconstruct.splats.looks import ModelView, squared
from devrf.reconstruct.splats.make import Splats, make_splats
from devrf.reconstruct.splats.moving import moved
from devrf.reconstruct.splats.packed import PackedSplats, pack, size_at_most

SIZE = (30, 21)
BEHIND = torch.tensor([0.2, 0.5, 0.9])
FACING = Camera(*SIZE, np.array([[30.0, 0, 15], [0, 33, 10], [0, 0, 1]]), np.eye(4)[:3])


def render_gaussians(gaussians: Gaussians, camera: Camera, behind: torch.Tensor) -> torch.Tensor:
    """A picture; differentiable."""
    flat, depth, spread = flattened(gaussians, camera)
    size = (camera.width, camera.height)
    return splat(flat, *tiles_of(flat.detach(), depth.detach(), spread.detach(), size), size, behind)


def some(count: int, seed: int = 0) -> Gaussians:
    """Gaussians of all kinds before `FACING`, some of them beside the picture or behind the camera."""
    g = torch.Generator().manual_seed(seed)
    places = torch.randn(count, 3, generator=g) * torch.tensor([1.0, 1.0, 1.5]) + torch.tensor([0, 0, 3.0])
    return Gaussians(
        places,
        torch.randn(count, 4, generator=g),
        torch.randn(count, 3, generator=g) * 0.4 - 2,
        torch.randn(count, generator=g) * 3,
        torch.rand(count, 3, generator=g),
    )


def test_one_gaussian_in_closed_form() -> None:
    """Isotropic, on the axis: opacity o exp(-r^2 / 2 s^2) with s^2 = (f sigma / z)^2 + BLUR."""
    sigma, z, opacity = 0.2, 4.0, 0.8
    one = Gaussians(
        torch.tensor([[0.0, 0, z]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), np.log(sigma)).float(),
        torch.tensor([opacity]).logit(),
        torch.tensor([[1.0, 0.0, 0.5]]),
    )
    picture = render_gaussians(one, FACING, BEHIND).numpy()
    variances = (np.array([30.0, 33.0]) * sigma / z) ** 2 + BLUR
    v, u = np.mgrid[0:21, 0:30] + 0.5
    alpha = opacity * np.exp(-0.5 * ((u - 15) ** 2 / variances[0] + (v - 10) ** 2 / variances[1]))
    alpha[alpha < FAINT] = 0
    expected = alpha[..., None] * [1.0, 0.0, 0.5] + (1 - alpha[..., None]) * BEHIND.numpy()
    np.testing.assert_allclose(picture, expected, atol=2e-6)


@pytest.mark.parametrize("count", [0, 1, 200])
def test_the_kernel_is_its_reference(count: int) -> None:
    flat, depth, spread = flattened(some(count), FACING)
    lists = tiles_of(flat, depth, spread, SIZE)
    leaf = flat.clone().requires_grad_()
    weight = torch.randn(SIZE[1], SIZE[0], 3, generator=torch.Generator().manual_seed(1))
    pictures, gradients = [], []
    for draw in (splat, splat_ref):
        picture = draw(leaf, *lists, SIZE, BEHIND)
        pictures.append(picture.detach())
        if count:
            gradients.append(torch.autograd.grad((picture * weight).sum(), leaf)[0])
    torch.testing.assert_close(*pictures, rtol=0, atol=2e-6)  # a few roundings of numbers up to 1
    for a, b in zip(gradients[:1], gradients[1:], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_pixels_are_as_large_as_the_nearest_camera_that_sees_them_has_them() -> None:
    nearer = replace(FACING, cam_from_world=np.eye(4)[:3] + np.array([[0, 0, 0, 0]] * 2 + [[0, 0, 0, -1.0]]))
    places = torch.tensor([[0.0, 0, 3], [1.4, 0, 3], [0, 0, -3], [9, 0, 3]])
    np.testing.assert_allclose(pixel_sizes(places, [FACING, nearer]), [2 / 30, 3 / 30, 0, 0], rtol=1e-6)


def test_a_square_picture_holds_the_camera_s_own_in_its_middle() -> None:
    for camera in (
        FACING,
        replace(FACING, width=21, height=30, K=np.array([[30.0, 0, 10], [0, 33, 15], [0, 0, 1]])),
    ):
        wide = squared(replace(camera, distortion=np.array([0.1, 0, 0, 0, 0])))
        points = np.random.default_rng(0).uniform((-0.3, -0.3, 1), (0.3, 0.3, 2), (9, 3))
        border = np.array([30 - camera.width, 30 - camera.height]) / 2
        assert (wide.width, wide.height) == (30, 30)
        np.testing.assert_allclose(wide.project(points), camera.project(points) + border, atol=1e-9)


def test_tiles_miss_nothing() -> None:
    """The picture is that of tiles which all list everything."""
    flat, depth, spread = flattened(some(100), FACING)
    order = depth.argsort()[(depth[depth.argsort()] > 0.05)].int()
    tiles = -(-SIZE[0] // 8) * -(-SIZE[1] // 8)
    all_of_them = torch.arange(tiles + 1) * len(order), order.repeat(tiles)
    few = tiles_of(flat, depth, spread, SIZE)
    assert len(few[1]) < 0.7 * len(all_of_them[1])
    torch.testing.assert_close(
        splat_ref(flat, *few, SIZE, BEHIND), splat_ref(flat, *all_of_them, SIZE, BEHIND), rtol=0, atol=1e-6
    )


def test_a_similarity_moves_the_picture_with_the_camera() -> None:
    matrix = torch.eye(4)
    matrix[:3, :3] = 2.5 * rotations(torch.tensor([[0.3, -0.5, 0.7, 0.2]]))[0]
    matrix[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    before = some(50)
    before = before.only(before.places[:, 2] > 0.5)  # a nearest depth has a scale
    there = render_gaussians(transformed(before, matrix), FACING.moved(matrix.double().numpy()), BEHIND)
    torch.testing.assert_close(there, render_gaussians(before, FACING, BEHIND), rtol=0, atol=1e-4)


def test_quaternions_of_rotations() -> None:
    quats = torch.nn.functional.normalize(
        torch.randn(20, 4, generator=torch.Generator().manual_seed(2)), dim=1
    )
    again = quats_of(rotations(quats))
    assert torch.minimum((again - quats).norm(dim=1), (again + quats).norm(dim=1)).max() < 1e-5


def test_the_forward_motion_moves_what_is_in_its_box() -> None:
    model, rest = moving_ball(), torch.tensor([[0.1, 0.2, -0.3], [5.0, 0, 0]])
    there = moved(model, rest, 0.5)
    torch.testing.assert_close(there[0], rest[0] + torch.tensor([0.5 * TRAVEL, 0, 0]))
    assert torch.equal(there[1], rest[1]) and torch.equal(moved(model, rest, None), rest)


def ball_scene(folder: Path, moves: bool = True) -> Scene:
    """Cameras around the ball; their pictures are never read."""
    sweep = [PosedFrame(folder / "x.png", look_at(eye), "static", n, None, None, "train")
             for n, eye in enumerate(around(8, 0.0, 0.4))]  # fmt: skip
    moving = [PosedFrame(folder / "x.png", look_at(eye), f"cam{c}", n, float(n), float(n), "train")
              for c, eye in enumerate(around(3, 0.5, 0.3)) for n in range(2)]  # fmt: skip
    box = np.array([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]])
    return scene_of(sweep, moving if moves else (), aabb=box, near=0.3, far=9.0, background="white")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[DynamicModel, Splats, Splats]:
    """The moving ball, its splats as they are sampled, and fitted."""
    model, scene = moving_ball(), ball_scene(tmp_path_factory.mktemp("ball"))
    sampled, fitted = (make_splats(scene, model, 1500, [0.0, 0.5, 1.0], rounds=rounds) for rounds in (0, 2))
    return model, sampled, fitted


def psnr_of(model: DynamicModel, splats: Splats, key: int) -> float:
    """Against the model, from a place between the cameras."""
    camera = look_at(around(16, 0.2, 0.35)[3])
    with torch.no_grad():
        picture = render_gaussians(splats.at(key), camera, splats.behind).clamp(0, 1).numpy()
    return float(-10 * np.log10(((picture - render_view(model, camera, key / 2)) ** 2).mean()))


def test_splats_of_a_ball(made: tuple[DynamicModel, Splats, Splats]) -> None:
    model, sampled, fitted = made
    assert 1000 < len(sampled.gaussians) <= 1500 and sampled.moving == len(sampled.gaussians)
    away = sampled.gaussians.places.norm(dim=1)
    assert (away - RADIUS).abs().max() < 0.05  # a voxel
    assert (sampled.gaussians.colours - torch.tensor(COLOUR)).abs().median() < 0.02
    for key in range(3):  # the motion is the model's: the pictures are as good at all times
        before, after = psnr_of(model, sampled, key), psnr_of(model, fitted, key)
        assert after > before + 1 and after > 30, (key, before, after)


def test_none_becomes_finer_than_what_pictures_show(made: tuple[DynamicModel, Splats, Splats]) -> None:
    """Else they would be dots with gaps between them from nearer, or in a larger picture."""
    dots = replace(made[1].gaussians, log_scales=torch.full_like(made[1].gaussians.log_scales, -9.0))
    camera = look_at(around(16, 0.2, 0.35)[3])
    picture = ModelView(camera, 0.5, torch.from_numpy(render_view(made[0], camera, 0.5)))
    fitted = fit(made[0], (dots, None), [picture], made[1].behind, rounds=1)
    finest = FINEST_PX * pixel_sizes(fitted.places, [camera])
    assert (finest > 0).any() and (fitted.log_scales.exp() > 0.9 * finest[:, None]).all()


def test_splats_come_out_the_same_again(made: tuple[DynamicModel, Splats, Splats], tmp_path: Path) -> None:
    again = make_splats(ball_scene(tmp_path), made[0], 1500, [0.0, 0.5, 1.0], rounds=0)
    assert torch.equal(again.gaussians.places, made[1].gaussians.places)


def test_a_scene_at_rest_has_splats_that_stay(tmp_path: Path) -> None:
    model = DynamicModel(moving_ball().rest)
    splats = make_splats(ball_scene(tmp_path, moves=False), model, 600, [None], rounds=0)
    assert splats.moving == 0 and 300 < len(splats.gaussians) <= 600


def test_splats_go_and_turn_with_the_rigid_part_they_are_on(tmp_path: Path) -> None:
    model = moving_parts()
    sampled, fitted = (
        make_splats(ball_scene(tmp_path), model, 1200, [REST, 0.6, 1.0], rounds=rounds) for rounds in (0, 1)
    )
    for splats in (sampled, fitted):
        assert splats.nodes is not None and splats.moving == int((splats.nodes.part > 0).sum())
        for key, time in enumerate((REST, 0.6, 1.0)):
            now, (turns, shifts) = splats.at(key), motion_at(time)
            for node, thing in enumerate((SLAB, STICK, BALL)):
                own = splats.nodes.part == node
                turn, shift = (torch.from_numpy(x[thing]).float() for x in (turns, shifts))
                at_rest, there = splats.gaussians.only(own), now.only(own)
                assert len(there) > 50
                torch.testing.assert_close(there.places, at_rest.places @ turn.T + shift, rtol=0, atol=1e-5)
                torch.testing.assert_close(there.axes, turn @ at_rest.axes, rtol=0, atol=1e-5)
                if splats is sampled:  # each on the part that it shows
                    away = outside(thing, there.places.numpy(), time)
                    assert (np.abs(away) < 1.5 * model.rest.canonical.voxel).mean() > 0.97, (node, time)
    beyond = outside_of_swept(pack(sampled.gaussians, sampled.ways, sampled.nodes), sampled, model)
    assert beyond <= 1e-6  # between the times, too
    camera = look_at(around(16, 0.2, 0.35)[3])
    errors = []
    for key, time in enumerate((REST, 1.0)):
        with torch.no_grad():
            picture = render_gaussians(fitted.at(2 * key), camera, fitted.behind).clamp(0, 1).numpy()
        errors.append(float(((picture - render_view(model, camera, time)) ** 2).mean()))
    assert errors[1] < 1.5 * errors[0]  # as good where the stick has turned


def test_splats_on_soft_parts_each_have_a_way_of_their_own(tmp_path: Path) -> None:
    model = moving_parts()
    assert model.movers is not None
    stretch = torch.diag(torch.tensor([1.3, 0.9, 0.8]))
    stretches = torch.eye(3).repeat(len(model.movers.times), 2, 1, 1)
    stretches[-1, STICK] = stretch
    model.movers.stretches = stretches
    splats = make_splats(ball_scene(tmp_path), model, 1200, [REST, 1.0], rounds=0)
    assert splats.nodes is None and 300 < splats.moving < len(splats.gaussians)
    at_rest, there = (splats.at(key).places[: splats.moving] for key in (0, 1))
    on = torch.from_numpy(outside(STICK, at_rest.numpy(), REST)) < model.rest.canonical.voxel
    turns, shifts = (torch.from_numpy(x[STICK]).float() for x in motion_at(1.0))
    assert on.sum() > 50
    torch.testing.assert_close(there[on], at_rest[on] @ (turns @ stretch).T + shifts, rtol=0, atol=1e-4)


def outside_of_swept(packed: PackedSplats, splats: Splats, model: DynamicModel) -> float:
    """How far splats on nodes come out of the box that the page holds them to be in."""
    assert splats.nodes is not None
    lo, hi = (torch.tensor(end) for end in packed.about["swept"])
    own = splats.nodes.part > 0
    between = splats.nodes.then(model, torch.linspace(REST, 1, 21).tolist())
    places = torch.stack([between.at(n, splats.gaussians).places[own] for n in range(21)])
    return float(torch.maximum(lo - places, places - hi).max())


def test_packed_splats_unpack_as_documented(made: tuple[DynamicModel, Splats, Splats]) -> None:
    splats = made[2]
    packed = pack(splats.gaussians, splats.ways)
    about, data = json.loads(json.dumps(packed.about)), zlib.decompress(packed.data)
    n, m, keys = about["count"], about["moving"], about["keys"]
    assert len(data) == 23 * n + 6 * m * (keys - 1) and len(packed.data) <= size_at_most(n, m, keys)
    places = np.frombuffer(data, "<f4", 3 * n).reshape(n, 3)
    np.testing.assert_array_equal(places[:m], splats.ways[0].numpy())
    quats, scales = (
        np.frombuffer(data, np.uint8, k * n, at * n).reshape(n, k) for k, at in ((4, 12), (3, 16))
    )
    turned = torch.from_numpy(quats.astype(np.float32) - 128)
    assert (rotations(turned) - rotations(splats.gaussians.quats)).abs().max() < 0.03  # of bytes: 1/127 rad
    lo, hi = about["scales"]
    assert (
        np.abs(lo + (hi - lo) * scales / 255 - splats.gaussians.log_scales.numpy()).max() <= (hi - lo) / 509
    )
    at, now = 23 * n, places[:m].astype(np.float64)
    for key in range(1, keys):
        low, high = (np.frombuffer(data, np.uint8, 3 * m, at + k * 3 * m).astype(np.uint16) for k in (0, 1))
        now = now + about["step"] * (low | high << 8).astype(np.uint16).view(np.int16).reshape(m, 3)
        at += 6 * m
        assert np.abs(now - splats.ways[key].numpy()).max() <= 0.51 * about["step"]


def test_the_longest_way_there_and_back_fits() -> None:
    gaussians = replace(some(2), places=torch.zeros(2, 3))
    ways = torch.tensor([0.0, 7.0, -7.0, 7.0])[:, None, None].expand(4, 2, 3).contiguous()
    packed = pack(gaussians, ways)
    codes = np.frombuffer(zlib.decompress(packed.data), np.uint8)[46:].reshape(3, 2, 6).astype(np.uint16)
    steps = (codes[:, 0] | codes[:, 1] << 8).astype(np.uint16).view(np.int16)
    np.testing.assert_allclose(steps[:, 0].cumsum() * packed.about["step"], [7, -7, 7], atol=1e-3)


def test_a_splat_file_opens_in_plyfile(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    g, path = some(7), tmp_path / "s.ply"
    arrays = [x.numpy() for x in (g.places, g.colours, g.logits, g.log_scales, g.quats)]
    write_splat_ply(path, GaussianVertices(*arrays), ["unit: metres"])
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    names = [p.name for p in vertex.properties]
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"] and names[-4:] == [f"rot_{k}" for k in range(4)]
    np.testing.assert_array_equal(np.stack([vertex[a] for a in "xyz"], 1), g.places.numpy())
    rgb = 0.5 + 0.28209479177387814 * np.stack([vertex[f"f_dc_{k}"] for k in range(3)], 1)
    np.testing.assert_allclose(rgb, g.colours.numpy(), atol=1e-6)
    np.testing.assert_array_equal(vertex["opacity"], g.logits.numpy())
    np.testing.assert_array_equal(np.stack([vertex[f"scale_{k}"] for k in range(3)], 1), g.log_scales.numpy())
    unit = np.stack([vertex[f"rot_{k}"] for k in range(4)], 1)
    np.testing.assert_allclose(unit, torch.nn.functional.normalize(g.quats, dim=1).numpy(), atol=1e-6)
