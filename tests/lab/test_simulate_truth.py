"""Exact depth and flow, against closed forms."""

import cv2
import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.render.studio import Studio
from devrf.lab.simulate.render.true_geometry import TrueSurface, corners_of, flow_bwd
from devrf.lab.simulate.scenes.catalogue import WOOD, Mesh, texture
from devrf.lab.simulate.scenes.shapes import turn, turned

pytest.importorskip("mitsuba")
SIZE, FOCAL = 48, 60.0
K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1.0]])
CAMERA = Camera(SIZE, SIZE, K, look_at(np.array([0, -4.0, 0]), np.zeros(3)))  # looks along +y
EXACT = 1e-9  # double precision, numbers of a few units
GREY = np.full((4, 4, 3), 128, np.uint8)


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(spp=4)


def _upright(x: tuple[float, float], y: float, z: tuple[float, float] = (-9, 9)) -> Mesh:
    corners = np.array([[x[0], y, z[1]], [x[1], y, z[1]], [x[1], y, z[0]], [x[0], y, z[0]]])
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]]), uv, GREY)


def _seen(studio: Studio, *meshes: Mesh, camera: Camera = CAMERA) -> TrueSurface:
    return TrueSurface(camera, studio.stage(meshes).triangles(camera), corners_of(meshes))


def test_pixels_are_sampled_at_their_centres(studio: Studio) -> None:
    for edge_px, first in ((20.49, 20), (20.51, 21)):
        x = (edge_px - SIZE / 2) / FOCAL * 4
        seen = _seen(studio, _upright((x, 9), 0.0)).triangle >= 0
        np.testing.assert_array_equal(seen.all(0), np.arange(SIZE) >= first)
        np.testing.assert_array_equal(seen.any(0), np.arange(SIZE) >= first)


def test_depth_of_a_wall_and_of_a_tilted_plane(studio: Studio) -> None:
    wall = _upright((-9, 9), 1.0)
    np.testing.assert_allclose(_seen(studio, wall).depth, 5.0, atol=EXACT)
    R = turn("z", 40)[:3, :3]
    tilted = Mesh(wall.vertices @ R.T, wall.faces, wall.uv, GREY)
    normal, rays = R @ [0, 1, 0], CAMERA.directions(np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), -1))
    depth = (1.0 - normal @ CAMERA.centre) / (rays @ normal) * rays[..., 1]
    np.testing.assert_allclose(_seen(studio, tilted).depth, depth, atol=EXACT * 10)


def test_depth_of_a_sphere(studio: Studio) -> None:
    rise = np.linspace(-np.pi / 2, np.pi / 2, 121)
    profile = [(float(np.cos(a)), float(np.sin(a))) for a in rise]
    surface = _seen(studio, turned(np.random.default_rng(0), WOOD, profile))
    rays = CAMERA.directions(np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), -1))
    half = -rays @ CAMERA.centre
    root = half**2 - (CAMERA.centre @ CAMERA.centre - 1)
    middle = root > 0.5  # steep enough that a facet's sagitta (1 - cos of 3.75 degrees) shows at most doubled
    depth = (half - np.sqrt(root.clip(0))) * rays[..., 1]
    error = (surface.depth - depth)[middle]
    assert (error > -1e-6).all() and error.max() < 2 * (1 - np.cos(np.radians(3.75)))
    assert (surface.depth[root < -0.3] == 0).all()


def test_flow_of_a_wall_that_moves(studio: Studio) -> None:
    step = np.array([0.3, 0.0, -0.2])  # right and down, seen from the camera
    before = _upright((-9, 9), 1.0)
    now = Mesh(before.vertices + step, before.faces, before.uv, GREY)
    flow, mask = flow_bwd(_seen(studio, now), _seen(studio, before))
    np.testing.assert_allclose(
        flow, np.broadcast_to([-FOCAL * 0.3 / 5, -FOCAL * 0.2 / 5], flow.shape), atol=1e-7
    )
    column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    inside = (column + flow[..., 0] >= 0) & (row + flow[..., 1] >= 0)
    np.testing.assert_array_equal(mask, inside)


def test_flow_of_a_turning_wall_agrees_with_depth_and_motion(studio: Studio) -> None:
    before = _upright((-9, 9), 1.0)
    M = turn(np.array([0.3, -0.5, 0.8]), 7.0)
    now = Mesh(before.vertices @ M[:3, :3].T, before.faces, before.uv, GREY)
    surface = _seen(studio, now)
    flow, mask = flow_bwd(surface, _seen(studio, before))
    pixels = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), -1)
    rays = CAMERA.directions(pixels)
    points = CAMERA.centre + surface.depth[..., None] * rays / rays[..., 1:2]
    expected = CAMERA.project(points @ M[:3, :3]) - pixels  # M is undone
    assert mask.mean() > 0.8
    assert np.abs(flow - expected).max() < 1e-6


def test_the_picture_before_warped_by_the_flow_is_the_picture_now() -> None:
    studio = Studio(spp=16)
    rng = np.random.default_rng(0)
    picture = texture(rng, (400, 400), 0.01, 1.0, paint=WOOD, sizes_m=(0.3, 0.8))
    half = _upright((-2, 2), 1.0, (-2, 2))
    before = Mesh(half.vertices, half.faces, half.uv, picture)
    R = turn("y", 6.0)[:3, :3]  # in its own plane, so that the light on it stays nearly the same
    now = Mesh(half.vertices @ R.T + [0.1, 0, 0.05], half.faces, half.uv, picture)
    flow, mask = flow_bwd(_seen(studio, now), _seen(studio, before))
    taken = [studio.stage([mesh]).picture(CAMERA, 0)[..., :3].astype(np.float32) for mesh in (before, now)]
    x, y = np.meshgrid(np.arange(SIZE, dtype=np.float32), np.arange(SIZE, dtype=np.float32))
    # OpenCV counts a pixel's centre as a whole number; a flow is the same in both conventions.
    uv = flow.astype(np.float32)
    warped = cv2.remap(taken[0], x + uv[..., 0], y + uv[..., 1], cv2.INTER_LINEAR)
    mask[:2] = mask[-2:] = mask[:, :2] = mask[:, -2:] = False  # the blend would reach out of the picture
    error, still = (np.abs(p - taken[1])[mask].mean() for p in (warped, taken[0]))
    assert mask.mean() > 0.6 and error < 0.25 * still


def test_what_was_hidden_before_is_not_in_the_mask(studio: Studio) -> None:
    wall, board = _upright((-9, 9), 1.0), _upright((-0.5, 0.5), 0.0)
    moved = Mesh(board.vertices + [0.4, 0, 0], board.faces, board.uv, GREY)
    now, before = _seen(studio, wall, moved), _seen(studio, wall, board)
    flow, mask = flow_bwd(now, before)
    on_board, was_board = now.triangle >= 2, before.triangle >= 2
    assert (flow[~on_board] == 0).all() or np.abs(flow[~on_board]).max() < 1e-9
    np.testing.assert_allclose(flow[on_board][:, 0], -FOCAL * 0.4 / 4, atol=1e-7)
    np.testing.assert_array_equal(mask, on_board | ~was_board)
    assert (~mask).sum() == 6 * SIZE  # the board uncovered 0.4 units at depth 4: 6 columns


def test_nothing_seen_is_nothing(studio: Studio) -> None:
    away = _seen(studio, _upright((5, 6), 0.0))
    flow, mask = flow_bwd(away, away)
    assert not mask.any() and not flow.any() and not away.depth.any()
