"""Objects that deform: at rest exactly until the motion begins, and moving as real things do."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from devrf.lab.simulate.scenes.bodies import TABLE_TOP_M
from devrf.lab.simulate.scenes.catalogue import (
    CENTRE,
    PLATFORM_M,
    ROOM_HALF_M,
    ROOM_HEIGHT_M,
    WALLS,
    MovingObject,
    Paint,
    room,
    texture,
)
from devrf.lab.simulate.scenes.changing import CHANGES
from devrf.lab.simulate.scenes.furniture import ROOMS, furnished
from devrf.lab.simulate.scenes.objects import OBJECTS, SHEET_HEIGHT_M, SHEET_TOP_M, SHEET_WIDTH_M, make_object
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import ball, rounded_box
from devrf.lab.simulate.session.camera_rig import fixed_cameras, sweep_cameras
from devrf.lab.simulate.session.session_files import swaying

TIMES_S = np.linspace(0.05, 2.5, 12)
PEOPLE = ("kicking", "hiding", "pair", "placing")
RIGID = ("tumble", "leaving", "rod")
KINDS = [name for name in OBJECTS if name != "changing"] + list(CHANGES)


def _made(kind: str, **options: float) -> MovingObject:
    """An object, or what the one that changes does."""
    if kind in CHANGES:
        chosen = SessionOptions.model_validate({"change": kind, **options})
        return make_object("changing", np.random.default_rng(0), chosen)
    return make_object(kind, np.random.default_rng(0), SessionOptions.model_validate(options))


@pytest.mark.parametrize("name", KINDS)
def test_object_is_at_rest_until_it_moves_by_a_visible_amount(name: str) -> None:
    thing = _made(name)
    for time_s in (-1.0, 0.0):
        np.testing.assert_array_equal(thing.vertices_at(time_s), thing.rest.vertices)
    way = np.stack([thing.vertices_at(t) - thing.rest.vertices for t in TIMES_S])
    largest_m = np.linalg.norm(way, axis=-1).max()
    assert 0.1 < largest_m < (1.8 if name == "leaving" else 0.9)
    assert np.abs(thing.vertices_at(1e-3) - thing.rest.vertices).max() < 1e-4  # it does not jump
    lo, hi = (thing.rest.vertices + way).min((0, 1)), (thing.rest.vertices + way).max((0, 1))
    in_workshop = name == "workshop"  # whose floor has no platform, and whose lamp hangs higher
    assert lo[2] > (-0.02 if in_workshop else 0.3)
    if name != "leaving":
        assert (hi - lo < (1.9 if in_workshop else 1.5)).all()
        assert np.abs((lo + hi) / 2 - CENTRE)[:2].max() < (0.3 if in_workshop else 0.2)


@pytest.mark.parametrize("name", [name for name in KINDS if name not in RIGID])
def test_motion_is_not_rigid(name: str) -> None:
    thing = _made(name)
    a, b = thing.rest.vertices, thing.vertices_at(1.3)
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = vt.T @ np.diag([1, 1, np.linalg.det(vt.T @ u.T)]) @ u.T  # Kabsch: the best rigid motion
    left_m = np.linalg.norm((b - b.mean(0)) - (a - a.mean(0)) @ R.T, axis=1)
    assert left_m.max() > 0.02


@pytest.mark.parametrize(
    "name", ["sheet", "blocks", "figure", "plant", "leaving", "rod", "workshop", *PEOPLE]
)
def test_motion_scale_zero_stays_at_rest(name: str) -> None:
    thing = make_object(name, np.random.default_rng(0), SessionOptions(motion_scale=0))
    np.testing.assert_array_equal(thing.vertices_at(1.7), thing.rest.vertices)


def test_threads_of_the_sheet_hang_from_the_bar_and_keep_their_length() -> None:
    thing = make_object("sheet", np.random.default_rng(0), SessionOptions())
    for time_s in (0.0, 0.9, 2.1):
        threads = thing.vertices_at(time_s).reshape(64, 68, 3)
        np.testing.assert_allclose(threads[0, :, 2], SHEET_TOP_M)
        length_m = np.linalg.norm(np.diff(threads, axis=0), axis=-1).sum(0)
        # steps are means of neighbouring unit vectors, so a bent thread is a little shorter, never longer
        assert (length_m <= SHEET_HEIGHT_M + 1e-9).all() and (length_m > 0.998 * SHEET_HEIGHT_M).all()


def test_strips_of_the_sheet_have_the_width_and_gaps_that_were_asked_for() -> None:
    thing = make_object("sheet", np.random.default_rng(0), SessionOptions(strip_m=0.02))
    faces, y = thing.rest.faces, thing.rest.vertices[:, 1]
    wide = np.ptp(y[faces], axis=1)
    np.testing.assert_allclose(wide, 0.01)  # a strip is two faces wide
    edges = np.unique(y[faces].round(6))
    gaps = np.diff(edges)[2::3]
    assert gaps == pytest.approx(0.02, abs=0.002) and np.ptp(edges) == pytest.approx(SHEET_WIDTH_M)
    across = thing.rest.uv[:, 0]  # a point of the print is where it is on the whole sheet
    np.testing.assert_allclose(across, y / SHEET_WIDTH_M + 0.5, atol=1e-12)


def test_what_appears_is_not_there_at_rest_and_halves_touch() -> None:
    ball = _made("appear")
    assert np.ptp(ball.rest.vertices, axis=0).max() < 0.003  # metres: less than a pixel
    assert np.ptp(ball.vertices_at(2.0), axis=0).min() == pytest.approx(0.4, abs=0.01)
    block = _made("part", motion_scale=0.5)
    apart = block.vertices_at(2.0)[:, 1] - block.rest.vertices[:, 1]
    np.testing.assert_allclose(np.abs(apart), 0.075)
    inner = np.abs(block.rest.vertices[:, 1]).min()
    assert inner == pytest.approx(0, abs=1e-9)


def test_what_turns_over_shows_its_underside_and_stays_on_its_plinth() -> None:
    thing = _made("tumble")
    under = thing.rest.vertices[:, 2] == thing.rest.vertices[:, 2].min()
    turned = thing.vertices_at(2.0)
    assert turned[under, 0].min() == pytest.approx(turned[:, 0].max())  # now before the fixed cameras
    for time_s in (0.2, 0.5, 2.0):
        assert thing.vertices_at(time_s)[:, 2].min() == pytest.approx(thing.rest.vertices[:, 2].min())


def test_foot_and_seam_of_the_column() -> None:
    thing = make_object("column", np.random.default_rng(0), SessionOptions())
    moved = thing.vertices_at(1.4).reshape(56, 72, 3)
    np.testing.assert_allclose(moved[:, 0], moved[:, -1], atol=1e-12)  # closed around
    assert np.linalg.norm(moved[-1] - moved[-1, 0], axis=-1).max() < 0.004  # closed at the top
    rest = thing.rest.vertices.reshape(56, 72, 3)
    assert np.abs(moved[0].mean(0) - rest[0].mean(0)).max() < 0.01


def test_faces_look_outward_or_into_the_room() -> None:
    column = make_object("column", np.random.default_rng(0), SessionOptions()).rest
    a, b, c = (column.vertices[column.faces[:, i]] for i in range(3))
    outward = (np.cross(b - a, c - a)[:, :2] * ((a + b + c) / 3 - CENTRE)[:, :2]).sum(1)
    assert (outward >= -1e-9).mean() > 0.97  # bulges turn a few the other way in plan
    for wall in room(np.random.default_rng(0), 1.0).still[:4]:
        a, b, c = wall.vertices[wall.faces[0]]
        middle = wall.vertices.mean(0)
        assert np.isclose(np.abs(middle[:2]).max(), ROOM_HALF_M)
        assert np.cross(b - a, c - a)[:2] @ middle[:2] < 0


def test_textures_differ_by_seed_and_vanish_without_contrast() -> None:
    def make(seed: int, contrast: float) -> np.ndarray:
        return texture(np.random.default_rng(seed), (60, 80), 0.006, contrast, paint=WALLS[0])

    np.testing.assert_array_equal(make(0, 1.0), make(0, 1.0))
    assert np.abs(make(0, 1.0).astype(int) - make(1, 1.0)).mean() > 10
    np.testing.assert_array_equal(make(0, 0.0), np.broadcast_to(WALLS[0].tint, (60, 80, 3)))


@pytest.mark.parametrize("kind", ROOMS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))])
def test_no_camera_stands_in_the_furniture(kind: str, seed: int) -> None:
    around, options = furnished(kind, np.random.default_rng(seed), 1.0), SessionOptions(board=False)
    fixed = [c.camera for c in fixed_cameras(np.random.default_rng(seed), 4, (64, 48), options)]
    cameras = [*fixed, *sweep_cameras(np.random.default_rng(seed), (64, 48), options)]
    for mesh in (*around.still, *around.behind):
        lo, hi = mesh.vertices.min(0), mesh.vertices.max(0)
        if (hi - lo).max() > 2 * ROOM_HALF_M - 1:
            continue  # a wall or the floor
        for camera in cameras:  # how far the camera is from the box round this surface
            away_m = np.linalg.norm(np.maximum(np.maximum(lo - camera.centre, camera.centre - hi), 0))
            assert away_m > 0.1, f"a camera at {camera.centre} stands at a surface from {lo} to {hi}"


@pytest.mark.parametrize("kind", ROOMS)
def test_walls_of_furnished_rooms_are_plain_and_face_inward(kind: str) -> None:
    around = furnished(kind, np.random.default_rng(0), 1.0)
    # not what the window shows
    inside = [m for m in around.still if np.abs(m.vertices).max() <= ROOM_HEIGHT_M]
    walls = [m for m in inside if np.ptp(m.vertices[:, 2]) > 3 and np.ptp(m.vertices, axis=0)[:2].max() > 3]
    assert len(walls) >= 3
    for wall in walls:
        a, b, c = wall.vertices[wall.faces[0]]
        assert np.cross(b - a, c - a)[:2] @ wall.vertices.mean(0)[:2] < 0
        assert np.ptp(wall.texture.reshape(-1, 3), axis=0).max() <= 6
    flat = furnished(kind, np.random.default_rng(0), 0.0)
    assert all(np.ptp(m.texture.reshape(-1, 3), axis=0).max() == 0 for m in flat.still)


def test_blocks_touch_while_one_pushes_the_other_and_never_overlap() -> None:
    thing = make_object("blocks", np.random.default_rng(0), SessionOptions())
    count = len(rounded_box(np.random.default_rng(0), (1.0, 1.0, 1.0), Paint((0, 0, 0))).vertices)
    gaps = []
    for time_s in TIMES_S:
        first, second, rolling = np.split(thing.vertices_at(time_s), [count, 2 * count])
        gaps.append(second[:, 1].min() - first[:, 1].max())
        assert rolling[:, 1].min() - second[:, 1].max() > -1e-6
        assert abs(rolling[:, 2].min() - TABLE_TOP_M) < 2e-3  # it rolls on the table
    assert min(gaps) > -1e-6 and np.sum(np.abs(gaps) < 1e-6) > 5 and gaps[0] > 0.05


def test_a_hand_of_the_figure_is_at_its_thigh_at_rest_and_leaves_it() -> None:
    thing = make_object("figure", np.random.default_rng(0), SessionOptions())
    distances = []
    for time_s in (0.0, 0.8):
        parts = np.split(thing.vertices_at(time_s), np.cumsum(_figure_sizes(thing))[:-1])
        thigh, forearm = parts[4], parts[8]
        distances.append(cdist(thigh, forearm).min())
    assert distances[0] < 0.02 < 0.05 < distances[1]


def test_a_kick_is_fast_and_the_leg_comes_back_slowly() -> None:
    thing = make_object("kicking", np.random.default_rng(0), SessionOptions())
    times_s = np.arange(0.0, 2.4, 0.05)
    shoe_m = np.stack([_parts(thing, t)[11].mean(0) for t in times_s])
    speed_m_s = np.linalg.norm(np.diff(shoe_m, axis=0), axis=1) / 0.05
    fastest = float(times_s[speed_m_s.argmax()])
    assert 0.45 < fastest < 0.8 and speed_m_s.max() > 2.5
    assert speed_m_s[times_s[:-1] > 0.9].max() < 0.5 * speed_m_s.max()


def test_a_hidden_forearm_is_behind_the_back_and_comes_back_turned() -> None:
    thing = make_object("hiding", np.random.default_rng(0), SessionOptions())
    trunk, before, hidden, after = (
        _parts(thing, t)[n] for t, n in ((0.0, 1), (0.0, 13), (1.1, 13), (2.0, 13))
    )
    assert before[:, 0].max() > trunk[:, 0].max()  # before it, as the fixed cameras look
    assert np.median(hidden[:, 0]) < trunk[:, 0].mean()  # the hand, not the elbow
    assert np.linalg.norm(after - before, axis=1).max() > 0.05  # other sides are seen


def test_a_cube_is_where_the_hand_puts_it() -> None:
    thing = make_object("placing", np.random.default_rng(0), SessionOptions())
    at = {t: _parts(thing, t) for t in (0.0, 0.3, 1.2, 1.8, 2.6)}
    cube = {t: parts[14] for t, parts in at.items()}
    np.testing.assert_array_equal(cube[0.0], cube[0.3])
    np.testing.assert_allclose(cube[1.8], cube[2.6], atol=1e-9)
    assert cube[1.2][:, 2].min() > cube[0.0][:, 2].min() + 0.05  # it is carried
    assert abs(cube[2.6][:, 2].min() - cube[0.0][:, 2].min()) < 0.01  # and stands as high as before
    gaps = {t: cdist(parts[13], cube[t]).min() for t, parts in at.items()}
    # distances of vertices: those of the cube are at its edges
    assert max(gaps[1.2], gaps[1.8]) < 0.05 and gaps[2.6] > gaps[1.8] + 0.03


@pytest.mark.parametrize("name", PEOPLE)
def test_people_stand_on_the_platform(name: str) -> None:
    thing = make_object(name, np.random.default_rng(0), SessionOptions())
    for time_s in (0.0, 1.0, 2.2):
        assert abs(thing.vertices_at(time_s)[:, 2].min() - PLATFORM_M) < 0.03


def test_who_sways_stands_firm_and_is_at_rest_for_the_fixed_cameras() -> None:
    thing = make_object("pair", np.random.default_rng(0), SessionOptions())
    moved = swaying(thing.rest, 0.8, 0.02).vertices - thing.rest.vertices
    z = thing.rest.vertices[:, 2]
    assert np.abs(moved[z == z.min()]).max() == 0 and 0.015 < np.abs(moved[z == z.max()]).max() < 0.021
    assert swaying(thing.rest, 0.8, 0.0) is thing.rest


def _parts(thing: MovingObject, time_s: float) -> list[np.ndarray]:
    """Trunk, chest, neck and head; of the left and of the right side thigh, shin, shoe, upper and forearm; the rest."""
    of_box, _, of_limb, of_ball, *_ = _figure_sizes(
        make_object("kicking", np.random.default_rng(0), SessionOptions())
    )
    side = [of_limb, of_limb, of_box, of_limb, of_limb]
    sizes = np.cumsum([of_box, of_box, of_limb, of_ball, *side, *side, of_box])
    return np.split(thing.vertices_at(time_s), sizes)


def _figure_sizes(thing: MovingObject) -> list[int]:
    """Vertices of each part: two boxes, the neck and the head; then per side thigh, shin, shoe, upper arm, forearm."""
    rng, paint = np.random.default_rng(0), Paint((0, 0, 0))
    of_box = len(rounded_box(rng, (1.0, 1.0, 1.0), paint).vertices)
    of_ball = len(ball(rng, paint, 1.0).vertices)
    of_limb = (len(thing.rest.vertices) - 4 * of_box - of_ball) // 9
    side = [of_limb, of_limb, of_box, of_limb, of_limb]
    return [of_box, of_box, of_limb, of_ball, *side, *side]
