"""The scene box of synthetic captures: a moving ball in a room, a subject in a ring of cameras."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from devrf.calibration.extent.bounds import VOXEL, Bounds, Silhouettes, focus_point, scene_bounds
from devrf.calibration.extent.box_checks import cut_off, not_explained, not_swept, outside_box
from devrf.calibration.extent.mask_box import MaskHull
from devrf.calibration.extent.motion_masks import MotionMask, motion_mask
from devrf.calibration.intrinsics import guess
from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at

BALL = np.array([0.4, -0.3, 0.2])
RADIUS = 0.3
AROUND = np.array([[-2.2] * 3, [2.2] * 3])
CAMERA = guess(120, 90).at(np.eye(3, 4))


def camera_at(centre: np.ndarray, target: np.ndarray) -> Camera:
    return guess(200, 150).at(look_at(centre, target))


def ring(count: int, arc: float, radius: float = 2.5) -> list[Camera]:
    """Cameras on an arc, all looking at the origin."""
    angles = np.linspace(-arc / 2, arc / 2, count)
    return [camera_at(np.array([radius * np.sin(a), -radius * np.cos(a), 0.6]), np.zeros(3)) for a in angles]


def ball_mask(camera: Camera, centre: np.ndarray = BALL, radius: float = RADIUS) -> MotionMask:
    """Pixels whose ray passes through a ball."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1).astype(float))
    to_ball = centre - camera.centre
    away = np.linalg.norm(np.cross(rays, to_ball), axis=-1)
    return MotionMask(camera, away < radius)


NONE = np.zeros((0, 3)), np.zeros(0)  # points, and distances to them


@pytest.fixture(scope="module")
def bounds() -> Bounds:
    """The box of the ball before four cameras, by their masks alone."""
    fixed = ring(4, 2.2)
    return scene_bounds(fixed, fixed, *NONE, Silhouettes([ball_mask(c) for c in fixed]))


def in_box(bounds, points: np.ndarray) -> np.ndarray:
    """Points in the box frame."""
    return points @ bounds.box_from_world[:3, :3].T + bounds.box_from_world[:3, 3]


def room(rng: np.random.Generator) -> np.ndarray:
    """Points on the walls of a room."""
    points = rng.uniform(-3, 3, (2000, 3))
    points[np.arange(2000), rng.integers(0, 3, 2000)] = rng.choice([-3.0, 3.0], 2000)
    return points


def test_the_box_holds_what_moves_and_not_much_more():
    fixed = ring(4, 2.2)
    points = room(np.random.default_rng(0))
    distances = np.linalg.norm(points - fixed[0].centre, axis=1)
    bounds = scene_bounds(ring(20, 5.0), fixed, points, distances, Silhouettes([ball_mask(c) for c in fixed]))
    surface = np.random.default_rng(1).normal(size=(500, 3))
    surface = BALL + RADIUS * surface / np.linalg.norm(surface, axis=1, keepdims=True)
    assert (np.abs(in_box(bounds, surface)) <= bounds.aabb[1] + 1e-9).all()
    assert (bounds.size < 4 * 2 * RADIUS).all()
    assert "4 cameras" in bounds.basis  # the visual hull, not the points
    assert bounds.kind == "inward"
    assert np.abs(bounds.aabb).max() == pytest.approx(1.0)
    np.testing.assert_allclose(bounds.aabb[0], -bounds.aabb[1])


def test_near_does_not_cut_the_box_and_far_reaches_the_walls():
    fixed = ring(4, 2.2)
    points = room(np.random.default_rng(0))
    distances = np.linalg.norm(points - fixed[0].centre, axis=1)
    bounds = scene_bounds(fixed, fixed, points, distances, Silhouettes([ball_mask(c) for c in fixed]))
    unit = np.cbrt(np.linalg.det(bounds.box_from_world[:3, :3]))
    for camera in fixed:
        assert bounds.near / unit <= np.linalg.norm(camera.centre - BALL) - RADIUS
    for (
        camera
    ) in fixed:  # the sightings are those of the first alone, and another stands farther from some wall
        assert bounds.far / unit >= np.percentile(np.linalg.norm(points - camera.centre, axis=1), 99)


def test_far_is_what_the_sweep_has_seen():
    sweep, points = ring(12, 2.2), room(np.random.default_rng(0))
    seen = np.linalg.norm(points - BALL, axis=1)  # less than from a camera to the wall across the room
    bounds = scene_bounds(sweep, [], points, seen)
    unit = np.cbrt(np.linalg.det(bounds.box_from_world[:3, :3]))
    across = max(np.percentile(np.linalg.norm(points - c.centre, axis=1), 99) for c in sweep)
    assert np.percentile(seen, 99) <= bounds.far / unit < across


def test_up_is_up():
    bounds = scene_bounds(ring(12, 5.0), [], *NONE)
    z = bounds.box_from_world[2, :3]
    np.testing.assert_allclose(z / np.linalg.norm(z), [0, 0, 1], atol=0.02)
    R = bounds.box_from_world[:3, :3] / np.cbrt(np.linalg.det(bounds.box_from_world[:3, :3]))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_sweep_alone_gets_the_points_around_its_focus():
    rng = np.random.default_rng(0)
    subject = 0.5 * rng.uniform(-1, 1, (800, 3))
    points = np.concatenate([subject, 3 * room(rng)])
    bounds = scene_bounds(ring(20, 5.0), [], points, np.full(10, 2.5))
    share = (np.abs(in_box(bounds, subject)) <= bounds.aabb[1]).all(1).mean()
    assert share > 0.9
    assert (bounds.size < 1.6).all()


def test_forward_facing_cameras_are_told_apart():
    cameras = [
        camera_at(np.array([x, -3.0, 0.2]), np.array([x, 0.0, 0.0])) for x in np.linspace(-0.5, 0.5, 6)
    ]
    assert scene_bounds(cameras, [], *NONE).kind == "forward"
    with pytest.raises(ValueError, match="without cameras"):
        scene_bounds([], [], *NONE)


def test_focus_ignores_a_camera_that_looks_away():
    cameras = [*ring(8, 3.0), camera_at(np.array([2.0, 2.0, 0.5]), np.array([9.0, 2.0, 0.5]))]
    assert np.linalg.norm(focus_point(cameras)) < 0.15


def test_masks_that_contradict_give_no_hull():
    fixed = ring(2, 1.0)
    masks = [ball_mask(fixed[0]), ball_mask(fixed[1], BALL + [0.0, 0.0, 0.9], 0.1)]
    assert MaskHull.of(masks, AROUND, np.eye(3)) is None
    assert MaskHull.of(masks[:1], AROUND, np.eye(3)) is None


def test_motion_mask_sees_motion_but_neither_noise_nor_exposure():
    """A patch that moves while the light changes; then a subject that fills most of the picture."""
    rng = np.random.default_rng(0)
    scene = rng.integers(60, 190, (90, 120)).astype(np.float64)
    patch, whole = [], []
    for n in range(16):
        picture = scene * (1 + 0.1 * np.sin(n)) + rng.normal(0, 1.5, scene.shape)
        picture[30:50, 20 + 3 * n : 40 + 3 * n] = 230
        patch.append(np.clip(picture, 0, 255).astype(np.uint8))
        picture = scene + rng.normal(0, 1.5, scene.shape)
        picture[:, 40:] = rng.integers(40, 215, (90, 80))  # two thirds; the median pixel's range is over 100
        whole.append(np.clip(picture, 0, 255).astype(np.uint8))
    mask = motion_mask(CAMERA, patch).mask
    assert mask[32:48, 30:70].mean() > 0.9
    assert mask[:22].mean() < 0.05 and mask[60:].mean() < 0.05
    mask = motion_mask(CAMERA, whole).mask
    assert mask[:, 45:].mean() > 0.95 and mask[:, :35].mean() < 0.05


def _clip(scene: np.ndarray, change, count: int = 24) -> list[np.ndarray]:
    """Pictures of a scene with noise, changed at each n in [0, 1]."""
    rng = np.random.default_rng(1)
    pictures = []
    for n in np.linspace(0, 1, count):
        picture = scene + rng.normal(0, 1.5, scene.shape)
        change(picture, float(n))
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    return pictures


def test_what_hardly_moves_counts_where_it_hangs_on_what_moves() -> None:
    """An arm swings by much at its end and by 19 grey levels at its foot; as faint a change elsewhere is none."""
    scene = np.random.default_rng(0).integers(80, 120, (90, 120)).astype(np.float64)

    def swing(picture: np.ndarray, n: float) -> None:
        picture[20:50, 30:50] += 90 * n
        picture[50:75, 30:50] += 19 * n
        picture[50:75, 90:110] += 19 * n

    found = motion_mask(CAMERA, _clip(scene, swing))
    mask = found.mask
    assert mask[22:73, 32:48].all() and not mask[:, 80:].any()
    assert found.much is not None and found.much[22:48, 32:48].all() and not found.much[56:].any()


def test_a_mover_that_is_seen_in_two_pictures_counts_and_in_one_does_not() -> None:
    scene = np.random.default_rng(0).integers(80, 120, (90, 120)).astype(np.float64)

    def flash(pictures: int):
        def change(picture: np.ndarray, n: float) -> None:
            if round(23 * n) in range(12, 12 + pictures):
                picture[20:50, 30:50] = 230

        return change

    assert motion_mask(CAMERA, _clip(scene, flash(2))).mask[22:48, 32:48].all()
    assert not motion_mask(CAMERA, _clip(scene, flash(1))).mask.any()


@pytest.mark.parametrize("count", [2, 4, 7])
def test_of_few_pictures_one_that_shows_a_mover_is_enough(count: int) -> None:
    scene = np.random.default_rng(0).integers(80, 120, (90, 120)).astype(np.float64)

    def comes(picture: np.ndarray, n: float) -> None:
        if n == 1:
            picture[20:50, 30:50] = 230

    mask = motion_mask(CAMERA, _clip(scene, comes, count)).mask
    assert mask[22:48, 32:48].all() and not mask[:, 60:].any()


def test_a_shadow_changes_no_pattern_and_a_mover_does() -> None:
    rng = np.random.default_rng(0)
    scene = rng.integers(80, 200, (90, 120)).astype(np.float64)
    mover = rng.integers(80, 200, (20, 20)).astype(np.float64)
    soft = np.clip(1.2 - np.hypot(*(np.mgrid[:90, :120] - np.array([45, 90])[:, None, None])) / 25, 0, 1)

    def change(picture: np.ndarray, n: float) -> None:
        picture *= 1 - 0.5 * n * soft
        x = 10 + round(20 * n)
        picture[30:50, x : x + 20] = mover

    pictures = _clip(scene, change)
    shadow = np.hypot(*(np.mgrid[:90, :120] - np.array([45, 90])[:, None, None])) < 12
    found = motion_mask(CAMERA, pictures)
    assert found.mask[shadow].all() and not found.moved[shadow].any()
    assert found.moved[32:48, 15:45].mean() > 0.95


def two_movers(fixed: list[Camera], second: np.ndarray, radius: float) -> list[MotionMask]:
    return [
        MotionMask(c, ball_mask(c, np.zeros(3), RADIUS).mask | ball_mask(c, second, radius).mask)
        for c in fixed
    ]


def test_the_box_holds_a_small_mover_beside_a_large_one() -> None:
    """A third as wide, a thirtieth of the volume."""
    fixed, second, radius = ring(5, 2.6), np.array([0.75, 0.1, 0.0]), RADIUS / 3
    bounds = scene_bounds(fixed, fixed, *NONE, Silhouettes(two_movers(fixed, second, radius)))
    ends = second + radius * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert (np.abs(in_box(bounds, ends)) <= bounds.aabb[1]).all()


def test_the_box_is_no_larger_than_explains_what_moves() -> None:
    """Two balls pass each other before cameras on one side: masks of all time are wide bands, and agree far behind."""
    fixed, radius, count = ring(4, 1.2), 0.12, 7
    there, back = np.linspace(-0.7, 0.7, count), np.linspace(0.7, -0.7, count)
    still = np.ones(count)
    ways = np.stack([[there, -0.25 * still, 0.1 * still], [back, 0.3 * still, -0.1 * still]]).transpose(
        2, 0, 1
    )

    def masks(times: range) -> list[MotionMask]:
        balls = ways[times.start : times.stop].reshape(-1, 3)
        return [MotionMask(c, np.any([ball_mask(c, b, radius).mask for b in balls], axis=0)) for c in fixed]

    stretches = [masks(range(n, n + 3)) for n in range(0, count - 1, 2)]
    hull = MaskHull.of(masks(range(count)), AROUND, np.eye(3), stretches)
    assert hull is not None
    whole, smallest = hull.box, hull.smallest_box()
    assert (whole[0] <= smallest[0]).all() and (whole[1] >= smallest[1]).all()
    balls = ways.reshape(-1, 3)
    sides = np.ptp(smallest, axis=0)
    assert (smallest[0] < balls.min(0)).all() and (smallest[1] > balls.max(0)).all()
    assert (sides < np.ptp(balls, axis=0) + 5 * radius).all()


def test_a_box_is_drawn_in_no_further_than_its_voxels_need() -> None:
    fixed = ring(4, 1.2)
    masks = [ball_mask(c, np.array([x, 0.0, 0.0]), 0.3) for c, x in zip(fixed, (0, 0.1, 0.1, 0), strict=True)]

    def sides(across: float) -> np.ndarray:
        return scene_bounds(fixed, fixed, *NONE, Silhouettes(masks, across=across)).size

    # A picture is 2.2 wide where the ball is: mean sides are 0.77, 0.81 and 0.83, of which a margin is a part.
    smallest, between, whole = (sides(across) for across in (0.0, 0.37, 1.0))
    assert (smallest <= between + 1e-9).all() and (between <= whole + 1e-9).all()
    assert smallest.prod() < between.prod() < whole.prod()


def test_where_light_alone_changes_the_box_is_what_masks_agree_on() -> None:
    fixed = ring(4, 2.2)
    masks = [MotionMask(c, ball_mask(c).mask, pattern=np.zeros((c.height, c.width), bool)) for c in fixed]
    bounds = scene_bounds(fixed, fixed, *NONE, Silhouettes(masks))
    assert np.isfinite(bounds.aabb).all() and np.isfinite(bounds.box_from_world).all()
    assert (np.abs(in_box(bounds, BALL[None])) <= bounds.aabb[1]).all() and (bounds.size < 8 * RADIUS).all()


def test_a_camera_that_does_not_film_in_a_stretch_says_nothing_of_it() -> None:
    fixed = ring(4, 2.2)
    masks = [ball_mask(c) for c in fixed]

    def smallest(*stretches: list[MotionMask | None]) -> np.ndarray:
        hull = MaskHull.of(masks, AROUND, np.eye(3), stretches)
        assert hull is not None
        return hull.smallest_box()

    whole = smallest()
    np.testing.assert_array_equal(smallest([masks[0], None, None, None]), whole)
    some = smallest([masks[0], None, *masks[2:]])
    assert (some[0] <= whole[0] + 1e-9).all() and (some[1] >= whole[1] - 1e-9).all()


def test_a_shadow_as_small_is_no_mover() -> None:
    fixed, second, radius = ring(5, 2.6), np.array([0.75, 0.1, 0.0]), RADIUS / 3
    masks = [
        MotionMask(m.camera, m.mask, pattern=ball_mask(m.camera, np.zeros(3)).mask)
        for m in two_movers(fixed, second, radius)
    ]
    bounds = scene_bounds(fixed, fixed, *NONE, Silhouettes(masks))
    assert np.abs(in_box(bounds, second[None])).max() > 1.0


def test_a_flat_mover_has_a_voxel_of_margin() -> None:
    fixed = ring(4, 2.2)
    lying = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * [0.5, 0.5, 0.01]
    masks = []
    for camera in fixed:
        mask = np.zeros((camera.height, camera.width), dtype=bool)
        u, v = camera.project(lying).astype(int).T
        mask[v, u] = True
        masks.append(MotionMask(camera, binary_dilation(mask, np.ones((5, 5)))))
    bounds = scene_bounds(fixed, fixed, *NONE, Silhouettes(masks))
    assert (np.abs(in_box(bounds, lying)).max(0) <= bounds.aabb[1] - 0.9 * VOXEL).all()


def test_a_mover_beyond_the_box_is_found_with_its_place(bounds: Bounds) -> None:
    """Somebody walks past one camera, at its upper left; what only darkens there is nobody."""
    fixed = ring(4, 2.2)
    masks = [ball_mask(c) for c in fixed]
    box = bounds.box_from_world, bounds.aabb
    assert all(cut_off(m, *box) is None for m in masks)
    passed = masks[1].mask.copy()
    passed[10:40, 0:20] = True
    found = cut_off(MotionMask(fixed[1], passed), *box)
    assert found is not None and found.place == pytest.approx((0.05, 25 / 150), abs=0.01)
    assert found.share == pytest.approx(600 / passed.sum())
    assert cut_off(MotionMask(fixed[1], passed, pattern=masks[1].mask), *box) is None


CURTAIN = [-1.5, 2.6, 0.55] + np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * [0.2, 0.05, 0.4]


def with_points(mask: MotionMask, points: np.ndarray) -> MotionMask:
    """A mask with what a camera sees of points, and a little around."""
    camera = mask.camera
    at = np.nan_to_num(camera.project(points), nan=-1.0)
    u, v = at[((at >= 0) & (at < [camera.width, camera.height])).all(1)].astype(int).T
    more = np.zeros_like(mask.mask)
    more[v, u] = True
    return MotionMask(camera, mask.mask | binary_dilation(more, np.ones((5, 5))))


@pytest.mark.full
def test_what_things_hide_from_some_cameras_is_where_the_others_see_it() -> None:
    """A thing that screens hide from two of four cameras: those say nothing of it."""
    fixed, points = ring(4, 2.2), room(np.random.default_rng(0))
    rng = np.random.default_rng(1)
    thing = [0.5, 0.6, 0.1] + rng.uniform(-0.15, 0.15, (4000, 3))
    masks = [ball_mask(c, np.zeros(3), 0.2) for c in fixed]
    masks = [with_points(m, thing) if n < 2 else m for n, m in enumerate(masks)]
    screens = []
    for camera in fixed[2:]:
        way = camera.centre - thing.mean(0)
        across = np.cross(way / np.linalg.norm(way), rng.normal(size=(4000, 3)))
        screens.append(thing.mean(0) + 0.3 * way + 0.4 * rng.uniform(0, 1, (4000, 1)) * across)
    open_room = scene_bounds(fixed, fixed, points, np.full(100, 3.0), Silhouettes(masks))
    bounds = scene_bounds(
        fixed, fixed, np.concatenate([points, *screens]), np.full(100, 3.0), Silhouettes(masks)
    )
    asked = bounds.box_from_world, bounds.aabb, bounds.before
    assert len(bounds.before) and all(found is None for found in not_explained(masks, *asked))
    assert (np.abs(in_box(bounds, thing)) <= bounds.aabb[1]).all(1).mean() > 0.98
    named = not_explained(masks, open_room.box_from_world, open_room.aabb)
    assert any(found is not None and found.share > 0.05 for found in named)


def test_a_curtain_that_only_two_of_four_cameras_film_is_in_the_box_or_named() -> None:
    """It waves far behind the focus, farther from it than the nearest camera."""
    fixed, points = ring(4, 2.2), room(np.random.default_rng(0))
    masks = [with_points(ball_mask(c, np.zeros(3), 0.2), CURTAIN) for c in fixed]
    before = [ball_mask(c, np.zeros(3), 0.2) for c in fixed]
    of_curtain = [float((m.mask & ~b.mask).sum() / m.mask.sum()) for m, b in zip(masks, before, strict=True)]
    assert [share > 0.1 for share in of_curtain] == [False, False, True, True]
    bounds = scene_bounds(fixed, fixed, points, np.full(100, 3.0), Silhouettes(masks))
    assert (np.abs(in_box(bounds, CURTAIN)) <= bounds.aabb[1]).all()
    assert all(found is None for found in not_explained(masks, bounds.box_from_world, bounds.aabb))

    around = bounds.box_from_world.copy()
    around[:3, 3] = 0.0  # a box around the focus, up to the cameras: every ray to the curtain meets it
    aabb = AROUND * np.cbrt(np.linalg.det(around[:3, :3]))
    assert outside_box(masks[3].mask[None], fixed[3], around, aabb)[0] == 0
    named = not_explained(masks, around, aabb)
    assert [found is not None and found.share > 0.15 for found in named] == [False, False, True, True]


def test_silhouettes_that_are_cut_by_the_border_leave_the_box_tight() -> None:
    """Cameras so near that each sees some of three balls only: without a fifth one farther away, too."""
    balls = np.array([[-0.6, 0.0, 0.0], [0.0, 0.0, 0.3], [0.6, 0.2, 0.0]])
    near = ring(4, 1.6, 1.2)

    def size(cameras: list[Camera]) -> float:
        masks = [
            MotionMask(c, np.any([ball_mask(c, ball, 0.12).mask for ball in balls], axis=0)) for c in cameras
        ]
        points = room(np.random.default_rng(0))
        bounds = scene_bounds(near, cameras, points, np.full(100, 3.0), Silhouettes(masks))
        assert (np.abs(in_box(bounds, balls)) <= bounds.aabb[1]).all()
        return float(bounds.size.prod())

    assert size(near) < 1.2 * size([*near, camera_at(np.array([0.3, -2.5, 0.8]), np.zeros(3))])


@pytest.mark.parametrize(
    ("sweep", "near"),
    [
        (ring(12, 5.0, 2.8), True),  # as near as the fixed cameras
        (ring(12, 5.0, 12.0), False),  # from the far end of the hall
        ([camera_at(c.centre, 3 * c.centre) for c in ring(12, 5.0, 2.8)], False),  # of the walls
        (ring(2, 1.0, 2.8), False),  # two pictures
    ],
)
def test_a_sweep_comes_near_the_box_or_does_not(bounds: Bounds, sweep: list[Camera], near: bool) -> None:
    left = not_swept(sweep, ring(4, 2.2), bounds.box_from_world, bounds.aabb)
    assert left < 0.1 if near else left > 0.9
