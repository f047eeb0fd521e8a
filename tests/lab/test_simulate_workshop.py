"""The workshop: hands that hold what they carry, materials, light that came a long way, phones as cameras."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from devrf.lab.simulate.render import daylight
from devrf.lab.simulate.render.daylight import DAYLIGHT, lit, merged
from devrf.lab.simulate.scenes import materials
from devrf.lab.simulate.scenes.catalogue import (
    ROOM_HALF_M,
    Mesh,
    MovingObject,
    Paint,
    picture_on_quad,
    texture,
)
from devrf.lab.simulate.scenes.objects import OBJECTS, make_object
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import rounded_box
from devrf.lab.simulate.scenes.workshop import (
    BENCH_M,
    BENCH_X_M,
    BENCH_Y_M,
    CUBE_M,
    LAND_S,
    LEAVE_S,
    TOUCH_S,
    workshop_room,
)
from devrf.lab.simulate.session.camera_rig import fixed_cameras, sweep_cameras
from devrf.lab.simulate_command import options_from

SURFACES = [getattr(materials, name) for name in (
    "wood", "planks", "plaster", "painted", "plaid", "twill", "linen", "skin", "hair", "head", "pegboard", "sky",
)]  # fmt: skip
BOX = len(rounded_box(np.random.default_rng(0), (1.0, 1.0, 1.0), Paint((0, 0, 0))).vertices)


def _phones() -> SessionOptions:
    """What the command line takes for this scene."""
    return options_from(SessionOptions, OBJECTS["workshop"].usual)


@cache
def _made(name: str) -> MovingObject:
    return make_object(name, np.random.default_rng(0), SessionOptions())


def _at(time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The whole object, its two palms and the cube."""
    every = _made("workshop").vertices_at(time_s)
    first = len(_made("kicking").rest.vertices)  # after a person come the palms and the cube, all boxes
    return every, every[first : first + 2 * BOX].reshape(2, BOX, 3), every[first + 2 * BOX : first + 3 * BOX]


def test_both_hands_hold_the_cube_from_touch_to_leave() -> None:
    for time_s in np.linspace(TOUCH_S, LEAVE_S, 9):
        _, palms, cube = _at(float(time_s))
        for palm in palms:
            assert cdist(palm, cube).min() < 0.06  # vertices of the cube are at its edges
            away_m = np.linalg.norm(palm.mean(0) - cube.mean(0)) - CUBE_M / 2
            assert 0.0 < away_m < 0.03  # beside it, not in it
    for time_s in (0.0, LEAVE_S + 0.4):
        _, palms, cube = _at(time_s)
        assert min(cdist(palm, cube).min() for palm in palms) > 0.06


def test_the_cube_stands_on_the_bench_is_lifted_and_stands_elsewhere() -> None:
    (_, _, first), (_, _, lifted), (_, _, last) = (_at(t) for t in (0.0, 1.6, LAND_S + 0.3))
    for cube in (first, last):
        assert cube[:, 2].min() == pytest.approx(BENCH_M, abs=2e-3)
        assert (cube[:, :2] > [BENCH_X_M[0], BENCH_Y_M[0]]).all()
    assert lifted[:, 2].min() > BENCH_M + 0.1
    assert np.linalg.norm(last.mean(0) - first.mean(0)) > 0.25


def test_feet_stay_at_the_floor() -> None:
    for time_s in (0.0, 0.3, 0.6, 1.5):
        assert abs(_at(time_s)[0][:, 2].min()) < 0.05


def test_no_camera_stands_in_the_workshop() -> None:
    options, places = _phones(), []
    for seed in range(8):
        fixed = [c.camera for c in fixed_cameras(np.random.default_rng(seed), 4, (64, 36), options)]
        path = sweep_cameras(np.random.default_rng(seed), (64, 36), options)
        places += [camera.centre for camera in (*fixed, *path)]
    centres = np.array(places)
    for mesh in (*workshop_room(np.random.default_rng(0), 1.0).still, *_made("workshop").stand):
        lo, hi = mesh.vertices.min(0), mesh.vertices.max(0)
        if (hi - lo).max() > 2 * ROOM_HALF_M - 1 or lo[0] < -ROOM_HALF_M - 1:
            continue  # a wall, the floor, or what the window shows
        away_m = np.linalg.norm(np.maximum(np.maximum(lo - centres, centres - hi), 0), axis=1)
        assert away_m.min() > 0.08, f"a camera stands at a surface from {lo} to {hi}"


@pytest.mark.parametrize("surface", SURFACES)
def test_materials_differ_by_seed_and_vanish_without_contrast(surface) -> None:
    paint = Paint((150, 120, 90), surface=surface)

    def made(seed: int, shape: tuple[int, int], contrast: float = 1.0) -> np.ndarray:
        return texture(np.random.default_rng(seed), shape, 0.005, contrast, paint=paint)

    picture = made(0, (50, 70))
    assert picture.shape == (50, 70, 3) and picture.std() > 2
    np.testing.assert_array_equal(picture, made(0, (50, 70)))
    assert (picture != made(1, (50, 70))).mean() > 0.3
    assert made(0, (4, 9)).shape == (4, 9, 3)  # of small things
    assert np.ptp(made(0, (50, 70), 0.0).reshape(-1, 3), axis=0).max() == 0


def test_light_is_less_in_a_corner_and_under_a_board(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(daylight, "MOST_CELLS", 12)
    grey = np.full((8, 8, 3), 150, np.uint8)
    floor = picture_on_quad(np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]]), grey)
    board = np.array([[-1, 1, 0.2], [0, 1, 0.2], [0, -1, 0.2], [-1, -1, 0.2]])
    wall = np.array([[-1, 1, 2], [1, 1, 2], [1, 1, 0], [-1, 1, 0.0]])
    (found,) = lit([floor, picture_on_quad(board, grey), picture_on_quad(wall, grey)], DAYLIGHT, 0)
    assert found.light is not None and len(found.vertices) == 12
    of_floor = _light_of(found, 0)
    assert of_floor[:, :3].mean() < 0.5 * of_floor[4:, -3:].mean()  # under the board, and free
    again = lit([floor, picture_on_quad(board, grey), picture_on_quad(wall, grey)], DAYLIGHT, 0)
    np.testing.assert_array_equal(again[0].light, found.light)


def test_merged_surfaces_keep_their_pictures() -> None:
    rng = np.random.default_rng(0)
    quads = [
        picture_on_quad(rng.normal(size=(4, 3)), rng.integers(0, 255, shape, dtype=np.uint8))
        for shape in ((5, 9, 3), (12, 7, 3), (3, 3, 3))
    ]
    whole = merged(quads)
    for n, quad in enumerate(quads):
        np.testing.assert_array_equal(whole.vertices[4 * n : 4 * n + 4], quad.vertices)
        a, b = (whole.uv[4 * n + k] * whole.texture.shape[1::-1] - 0.5 for k in (0, 2))
        (x0, y0), (x1, y1) = np.rint(a).astype(int), np.rint(b).astype(int)
        np.testing.assert_array_equal(whole.texture[y0 : y1 + 1, x0 : x1 + 1], quad.texture)


def test_phones_have_two_rates_and_one_stands_upright() -> None:
    fixed = fixed_cameras(np.random.default_rng(0), 4, (64, 36), _phones())
    rates_hz = [round(1 / np.diff(camera.file_times_s).mean()) for camera in fixed]
    assert rates_hz == [25, 30, 25, 30, 25]
    assert [camera.camera.width for camera in fixed] == [64, 64, 64, 36, 64]
    upright = fixed[3].camera
    assert upright.height == 64 and upright.K[0, 0] > upright.height * 0.8  # as long a lens as the others


def _light_of(mesh: Mesh, number: int) -> np.ndarray:
    """Light on one of several merged quads."""
    assert mesh.light is not None
    corners = mesh.uv[4 * number : 4 * number + 4] * mesh.light.shape[1::-1]
    (x0, y0), (x1, y1) = corners.min(0).astype(int), corners.max(0).astype(int) + 1
    return mesh.light[y0:y1, x0:x1]
