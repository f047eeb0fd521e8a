"""Points on two textured cards, each with its own motion, are followed, and found to be two rigid parts."""

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation
from tests.reconstruct.conftest import look_at

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, load_image
from devrf.capture.system.errors import OutOfTime
from devrf.flow.dis import DisFlow
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.tracking.cross_validation import CrossValidation
from devrf.reconstruct.tracking.follow import SurfaceTracks, _Following, _Task, follow_both_ways, moments
from devrf.reconstruct.tracking.follower import Follower
from devrf.reconstruct.tracking.likelihoods import MOMENTS, Likelihoods, likelihoods
from devrf.reconstruct.tracking.lost import recovery
from devrf.reconstruct.tracking.lost.recovery import carried, look_again
from devrf.reconstruct.tracking.moving_points import PRIOR, _cut, _in_planes, _links, _log_odds, moving_points
from devrf.reconstruct.tracking.offsets import Offsets, Shown, offsets_of, offsets_to_follow
from devrf.reconstruct.tracking.pose import FARTHER, Estimate, Shots, believed
from devrf.reconstruct.tracking.rigid import motion_of, residual, rigid_parts
from devrf.reconstruct.tracking.soft import soft_motion_of
from devrf.reconstruct.tracking.solver.graph import Graph, Pose
from devrf.reconstruct.tracking.solver.normal_equations import Pulls
from devrf.reconstruct.tracking.solver.solve import step
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.trajectory import Trajectory
from devrf.reconstruct.tracking.views.film import CameraFilm, fetched
from devrf.reconstruct.tracking.views.shot import Shot
from devrf.reconstruct.tracking.views.sight import Sight

SIDE, SPACING = 0.3, 0.03  # half a card's side; of the points on it
CENTRES = np.array([[-0.4, 0.0, 0.0], [0.4, 0.0, 0.1]])
PICTURES, REST = 9, 4  # of each camera; number of the one at rest
GAP = 1 / (PICTURES - 1)
WALL = -0.8  # y of the wall behind the cards
GONE_LATER = [3.0] * 8 + [-3.0] * (MOMENTS - 8)


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((256, 256, 3))
    fine = gaussian_filter(noise, (3, 3, 0)) - 0.5
    return np.clip(0.5 + 4 * fine, 0.05, 0.95)


TEXTURES = [texture(n) for n in range(3)]


def placed(card: int, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of a card away from its rest at time 0.5."""
    away = time - 0.5
    turn = Rotation.from_rotvec([0, 0.5 * away * (1 if card else -1), 0.6 * away]).as_matrix()
    return turn, away * (np.array([0.1, 0.15, 0.3]) if card else np.array([-0.2, 0.0, -0.25]))


def coloured(card: int, x: np.ndarray, z: np.ndarray, side: float) -> np.ndarray:
    at = [(x / side + 1) / 2 * 255, (z / side + 1) / 2 * 255]
    return np.stack([map_coordinates(TEXTURES[card][..., c], at, order=1, mode="wrap") for c in range(3)], -1)


def picture(camera: Camera, time: float) -> np.ndarray:
    """The wall and both cards, traced."""
    y, x = np.mgrid[: camera.height, : camera.width]
    d = camera.directions(np.stack([x + 0.5, y + 0.5], -1).astype(float))
    far = (WALL - camera.centre[1]) / d[..., 1]
    hit = camera.centre + far[..., None] * d
    out = coloured(2, hit[..., 0], hit[..., 2], 2.0)
    nearest = np.where(far > 0, far, np.inf)
    for card, centre in enumerate(CENTRES):
        R, t = placed(card, time)
        o, local = R.T @ (camera.centre - centre - t), d @ R
        at = -o[1] / local[..., 1]
        u, v = o[0] + at * local[..., 0], o[2] + at * local[..., 2]
        inside = (np.abs(u) < SIDE) & (np.abs(v) < SIDE) & (at > 0) & (at < nearest)
        out[inside] = coloured(card, u, v, SIDE)[inside]
        nearest = np.where(inside, at, nearest)
    return (255 * out).round().astype(np.uint8)


def on_cards() -> tuple[SurfacePoints, np.ndarray]:
    """Points on both cards at rest, and the card of each."""
    along = np.arange(-SIDE + SPACING / 2, SIDE, SPACING)
    x, z = (grid.ravel() for grid in np.meshgrid(along, along))
    flat = np.stack([x, np.zeros_like(x), z], 1)
    xyz, card = np.concatenate([flat + centre for centre in CENTRES]), np.repeat([0, 1], len(flat))
    return SurfacePoints(xyz, np.tile([0.0, 1.0, 0.0], (len(xyz), 1)), np.full_like(xyz, 0.5), SPACING), card


def true_tracks(surface: SurfacePoints, card: np.ndarray, times: np.ndarray) -> np.ndarray:
    out = np.empty((len(times), len(surface), 3))
    for n, time in enumerate(times):
        for number, centre in enumerate(CENTRES):
            R, t = placed(number, time)
            mine = card == number
            out[n, mine] = (surface.xyz[mine] - centre) @ R.T + centre + t
    return out


def filmed(folder: Path, times: np.ndarray) -> list[CameraFilm]:
    """The cards as three cameras film them at the same moments, in pictures a `GAP` apart."""
    out = []
    for name, eye in (("left", [-1.2, 2.2, 0.5]), ("middle", [0.1, 2.5, 0.2]), ("right", [1.2, 2.2, 0.4])):
        small = look_at(np.array(eye))
        K = np.array([[240.0, 0, 120], [0, 240, 90], [0, 0, 1]])
        camera = replace(small, width=240, height=180, K=K)
        taken = GAP * np.arange(len(times))
        frames = []
        for n, time in enumerate(times):
            path = folder / f"{name}_{n}.png"
            cv2.imwrite(str(path), picture(camera, time)[..., ::-1])
            frames.append(PosedFrame(path, camera, name, n, taken[n], taken[n], "train"))
        away = np.full((180, 240), np.inf)
        plate = np.zeros((180, 240, 3), np.float32) + 0.5
        out.append(CameraFilm(camera, frames, taken, 1.0, "shell", DisFlow(), away, plate))
    return out


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> list[CameraFilm]:
    return filmed(tmp_path_factory.mktemp("cards"), GAP * np.arange(PICTURES))


@pytest.fixture(scope="module")
def tracks(films: list[CameraFilm]) -> SurfaceTracks:
    surface, _ = on_cards()
    tracks, decisions = follow_both_ways(Graph(surface), films, 0.5)  # the clocks are right
    assert not decisions
    return tracks


def test_points_are_followed_from_the_middle_to_both_ends(tracks: SurfaceTracks) -> None:
    surface, card = on_cards()
    assert not tracks.offsets.any()
    assert np.allclose(tracks.times, np.linspace(0, 1, PICTURES))
    assert np.allclose(tracks.xyz[REST], surface.xyz)
    true = true_tracks(surface, card, tracks.times)
    assert np.linalg.norm(true[[0, -1]] - surface.xyz, axis=-1).mean() > 0.1
    wrong = np.linalg.norm(tracks.xyz - true, axis=-1)
    assert np.median(wrong) < 0.005 and np.percentile(wrong, 95) < 0.02  # a pixel is 0.01


@pytest.mark.parametrize("sign", [1, -1])
def test_offsets_are_told_whatever_tracks_hide_of_them(sign: int) -> None:
    """Four cameras that see most points; each point is anywhere near where all of them show it."""
    rng, gap, offsets = np.random.default_rng(0), 0.1, 0.1 * np.array([0.0, 0.6, -0.3, 0.05])
    way, hidden = 0.02 * rng.standard_normal((300, 3)), 0.01 * rng.standard_normal((300, 3))
    seen, shown = Offsets(np.zeros(4), rng.random((300, 3))), {}
    for _ in range(60):
        for camera, offset in enumerate(sign * offsets):
            points = np.flatnonzero(rng.random(300) < 0.8)
            derivative = 100 * rng.standard_normal((len(points), 2, 3))
            left = np.einsum("mia,ma->mi", derivative, offset / gap * way[points] + hidden[points])
            shown[camera] = Shown(points, left, derivative, np.ones(len(points)))
        seen.add(shown, way, gap)
    found, _ = offsets_of({sign: seen}, gap)
    assert found == pytest.approx(offsets - np.median(offsets), abs=0.03 * gap)
    followed = [0, found[1], found[2], 0]  # the others are too small
    assert offsets_to_follow([{sign: seen}], gap) == pytest.approx(followed)
    still = Offsets(np.zeros(4), np.zeros((300, 3)))
    still.add(shown, 0 * way, gap)  # nothing goes anywhere
    assert not still.blocks and not offsets_to_follow([{1: still}], gap).any()


@pytest.mark.parametrize(
    ("found", "followed"),
    [
        ([0.5, 0.16, 0.12, -0.02], [0.5, 0.16, 0, 0]),  # one is clear, one likely, two are chance
        ([0.14, 0.14, -0.14, 0.0], [0, 0, 0, 0]),  # none is clear
        ([0.4, 0.09, -0.4, 0.0], [0.4, 0, -0.4, 0]),
    ],
)
def test_offsets_are_followed_where_one_is_clear_and_others_are_no_chance(
    found: list[float], followed: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    gap, std = 0.1, 0.005
    monkeypatch.setattr(
        "devrf.reconstruct.tracking.offsets.offsets_of",
        lambda seen, gap: (gap * np.array(found), np.full(4, std)),
    )
    assert offsets_to_follow([_with([0, 0, 0, 0])], gap) == pytest.approx(gap * np.array(followed))


def _with(offsets: list[float]) -> dict[int, Offsets]:
    """What is seen when everything is followed with these offsets: nothing."""
    return {1: Offsets(np.array(offsets, dtype=float), np.zeros((1, 3)))}


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_two_times_tell_what_tracks_hide_of_offsets(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each time a share of what is left is found; the third camera is not moved by the first time."""
    gap, true = 0.1, np.array([0.04, 0.0, -0.008, 0.0])
    monkeypatch.setattr(
        "devrf.reconstruct.tracking.offsets.offsets_of",
        lambda seen, gap: (seen[1].now + share * (true - seen[1].now), np.full(4, 0.001)),
    )
    first = _with([share * 0.04, 0, 0, 0])
    assert offsets_to_follow([_with([0, 0, 0, 0]), first], gap) == pytest.approx(true)


@pytest.mark.full
def test_a_clock_that_is_wrong_by_more_than_a_picture_is_found(tmp_path: Path) -> None:
    """Two cards that set out from rest; one camera took its pictures later than it says."""
    surface, card = on_cards()
    still, late = 3, 1.4 * GAP
    films = filmed(tmp_path, 0.5 + 0.8 * GAP * np.maximum(0, np.arange(14) - still))
    wrong = [replace(films[0], times=films[0].times - late), *films[1:]]
    told: list[float] = []
    found, (decision,) = follow_both_ways(Graph(surface), wrong, GAP, told.append)
    assert told == sorted(told) and told[-1] > 0.7  # though everything was followed again
    assert str(decision).startswith("clocks: left +") and "ms instead of as they are" in str(decision)
    assert found.offsets == pytest.approx([late, 0, 0], abs=0.3 * GAP)
    true = true_tracks(surface, card, 0.5 + 0.8 * np.maximum(0, found.times - still * GAP))
    off = np.linalg.norm(found.xyz - true, axis=-1)
    assert np.median(off[-4:-2]) < 0.01


def test_what_is_lost_is_found_again_from_another_guess(films: list[CameraFilm]) -> None:
    surface, card = on_cards()
    graph = Graph(surface)
    of_node = np.argmin(np.abs(graph.nodes[:, :1] - CENTRES[:, 0]), axis=1)
    with ThreadPoolExecutor(1) as pool:
        follower = Follower(graph, films, np.linspace(0.5, 1, 5), Offsets(np.zeros(3), surface.xyz), pool)
        shifts = np.where(of_node[:, None] == 1, [0.0, 0.0, -0.35], [0.0, 0.0, 0.0])
        before = replace(follower.past.poses[0], shifts=shifts)  # as if one card had come from far away
        follower.past.poses.insert(0, before)
        follower.go_on()
    true = true_tracks(surface, card, np.array([0.625]))[0]
    wrong = np.linalg.norm(follower.past.xyz[-1] - true, axis=-1)
    assert np.median(wrong[card == 1]) < 0.01 and not follower.past.lost[-1].any()


@pytest.mark.parametrize("far", [True, False])
def test_what_goes_far_from_one_picture_to_the_next_is_found(tmp_path: Path, monkeypatch, far: bool) -> None:
    """By a twelfth of the picture. Of its coarse pattern the high-pass by which all is exact keeps little."""
    coarse = [gaussian_filter(np.random.default_rng(n).random((256, 256, 3)), (12, 12, 0)) for n in range(3)]
    monkeypatch.setattr(f"{__name__}.TEXTURES", [np.clip(0.5 + 16 * (x - 0.5), 0.05, 0.95) for x in coarse])
    films = filmed(tmp_path, np.array([0.5, 1.0]))
    surface, card = on_cards()
    true = true_tracks(surface, card, np.array([1.0]))[0]
    camera = films[0].camera
    way = np.linalg.norm(camera.project(true) - camera.project(surface.xyz), axis=1)
    assert np.median(way) > 15  # of 180 pixels
    with ThreadPoolExecutor(1) as pool:
        follower = Follower(Graph(surface), films, films[0].times, Offsets(np.zeros(3), surface.xyz), pool)
        if not far:
            monkeypatch.setattr(recovery, "_gone_far", lambda shots, expected: expected)
        follower.go_on()
    wrong = np.linalg.norm(follower.past.xyz[-1] - true, axis=-1)
    assert (np.median(wrong) < 0.01) == far and follower.past.lost[-1].any() != far


@pytest.mark.parametrize(
    ("seconds", "a_second", "apart_s"),
    [(3, 25, 0.04), (12, 25, 0.04), (24, 25, 0.08), (60, 25, 0.08), (60, 10, 0.1)],
)
def test_moments_of_long_clips_are_farther_apart_but_never_far(
    films: list[CameraFilm], seconds: float, a_second: float, apart_s: float
) -> None:
    taken = np.linspace(0, seconds, round(seconds * a_second) + 1)
    ends = [replace(films[0].frames[0], time_s=float(taken[n])) for n in (0, -1)]
    times, before = moments([replace(films[0], frames=ends, times=taken / seconds)], 0.0)
    assert before == 0 and len(times) == pytest.approx(1 + seconds / apart_s, abs=1)


def test_flow_is_followed_from_the_picture_at_the_moment_before(films: list[CameraFilm]) -> None:
    """Three pictures lie between two moments: where points are in the last of them nothing has said yet."""
    surface, card = on_cards()
    with ThreadPoolExecutor(1) as pool:
        clocks = Offsets(np.zeros(3), surface.xyz)
        follower = Follower(Graph(surface), films, 0.5 + 3 * GAP * np.arange(2), clocks, pool)
        shots = follower.shots()
        shots.come()
    true = true_tracks(surface, card, np.array([0.5 + 3 * GAP]))[0]
    for shot in shots.all:
        points, at, weight = shot.came
        there, rest = (shot.film.camera.project(xyz[points]) for xyz in (true, surface.xyz))
        off, way = (np.median(np.linalg.norm(x - there, axis=1)) for x in (at, rest))
        assert shot.n == REST + 3 and off < 0.2 * way


def test_a_camera_that_films_seldom_says_where_points_come_from_at_its_own_time(
    films: list[CameraFilm], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its last picture lies several moments back, where everything stood."""
    surface, card = on_cards()
    seldom = [*films[:2], replace(films[2], frames=films[2].frames[::4], times=films[2].times[::4])]
    true = true_tracks(surface, card, np.linspace(0.5, 1, 5))
    with ThreadPoolExecutor(1) as pool:
        clocks = Offsets(np.zeros(3), surface.xyz)
        follower = Follower(Graph(surface), seldom, np.linspace(0.5, 1, 5), clocks, pool)
        past, follower.past.xyz = follower.past, list(true[:4])
        assert np.allclose(past.at(0.5), true[0]) and np.allclose(past.at(0.4), true[0])
        assert np.allclose(past.at(0.5 + 1.5 * GAP), (true[1] + true[2]) / 2)
        assert np.allclose(past.at(0.5 + 3.5 * GAP), 1.5 * true[3] - 0.5 * true[2])
        asked: dict[int, tuple[int, np.ndarray]] = {}
        monkeypatch.setattr(
            Shot, "come", lambda shot, begin, there, *_: asked.update({shot.camera: (begin, there.xyz)})
        )
        follower.shots().come()
    assert [asked[camera][0] for camera in range(3)] == [REST + 3, REST + 3, 1]
    assert np.allclose(asked[0][1], true[3]) and np.allclose(asked[2][1], true[0])


@pytest.mark.full
def test_what_turns_back_between_the_moments_of_a_long_clip_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four pictures lie between two moments, in which things go to and fro by 17 pixels."""
    surface, card = on_cards()
    monkeypatch.setattr("devrf.reconstruct.tracking.follow.MOST_MOMENTS", 8)
    monkeypatch.setattr("devrf.reconstruct.tracking.follow.LONGEST_GAP_S", 1.0)
    true_times = 0.12 * np.abs(np.arange(33) % 10 - 5) - 0.1
    films = filmed(tmp_path, true_times)
    found = follow_both_ways(Graph(surface), films, 0.0)[0]
    assert len(found.times) == 9
    true = true_tracks(surface, card, np.interp(found.times, films[0].times, true_times))
    assert np.median(np.linalg.norm(found.xyz - true, axis=-1)) < 0.01 and found.lost.mean() < 0.4


@pytest.mark.full
def test_twelve_seconds_are_followed_as_well_as_one(tmp_path: Path) -> None:
    """There and back six times, eight pictures a second."""
    surface, card = on_cards()
    turns = np.abs((np.arange(97) + 4) % 16 - 8) / 8
    found = follow_both_ways(Graph(surface), filmed(tmp_path, turns), 0.0)[0]
    true = true_tracks(surface, card, turns)
    errors = np.linalg.norm(found.xyz - true, axis=-1).reshape(-1, len(surface))[1:].reshape(12, -1)
    assert (np.median(errors, axis=1) < 0.1 * SPACING).all()
    assert (np.quantile(errors, 0.9, axis=1) < 0.01).all()
    assert errors[-2:].mean() < 1.1 * errors[:2].mean() and not found.lost.any()


class Remembers:
    """A method of flow that says that nothing moves, and remembers what it was shown."""

    name, parallel = "remembers", True

    def __init__(self, contrast: bool) -> None:
        self.takes_contrast, self.pictures = contrast, list[np.ndarray]()

    def estimate(self, image0, image1):
        self.pictures += [image0, image1]
        return np.zeros((*image0.shape[:-1], 2), np.float32)


@pytest.mark.parametrize("contrast", [False, True])
def test_methods_of_flow_see_colours_but_those_that_ask_for_contrast(
    films: list[CameraFilm], contrast: bool
) -> None:
    """Of the pictures that were taken and of those that are drawn."""
    surface, _ = on_cards()
    method = Remembers(contrast)
    taken = [replace(film, estimator=method) for film in films]
    with ThreadPoolExecutor(1) as pool:
        clocks = Offsets(np.zeros(3), surface.xyz)
        follower = Follower(Graph(surface), taken, np.linspace(0.5, 1, 5), clocks, pool)
        shots = follower.shots()
        shots.come()
        came, method.pictures = method.pictures, []
        shots.fit(follower.past.poses[0], ((1.2, 0.0),))
    for shown in (came, method.pictures):
        assert len(shown) == 12 and all(picture.dtype == np.uint8 for picture in shown)
        assert all(np.ptp(picture, axis=-1).any() != contrast for picture in shown)
    if not contrast:
        before, now = (load_image(films[0].frames[n], 1.0, "shell") for n in (REST, REST + 1))
        assert np.array_equal(came[0], before) and np.array_equal(came[1], now)
        drawn, true = method.pictures[:2]
        assert np.array_equal(true, now)
        on_card = np.abs(drawn.astype(int) - before).max(-1) < 30  # beside what stands, a grey plate
        assert 0.2 < on_card.mean() < 0.9


def test_all_that_is_lost_is_looked_for_at_the_same_moments(films: list[CameraFilm], monkeypatch) -> None:
    """One more node is lost at each moment; how far things went is only asked of what was not lost before."""
    surface, _ = on_cards()
    graph = Graph(surface)
    lost, looked, far = np.zeros(len(graph.nodes), dtype=bool), [], []
    with ThreadPoolExecutor(1) as pool:
        clocks = Offsets(np.zeros(3), surface.xyz)
        past = Trajectory(graph, np.linspace(0.5, 1, 12))
        rest, known = past.poses[0], np.full(len(lost), np.nan)
        monkeypatch.setattr(Shots, "likeness", lambda *_: known)
        monkeypatch.setattr(Shots, "fit", lambda *_: looked.append(moment) or rest)
        monkeypatch.setattr(recovery, "_gone_far", lambda *_: far.append(moment) or rest)
        for moment in range(1, 11):
            if moment != 9:  # the one at which nothing more is lost
                lost[: moment + 1] = True
            if moment == 10:
                lost[: moment + 2] = True  # two at once: these are looked for now, and the others with them
            found = Estimate(rest, lost.copy(), known)
            look_again(Shots(past, [], clocks.now, pool), found, rest)
            past.add(found.pose, found.lost)
    assert sorted(set(looked)) == [1, 5, 9, 10] and far == [1, 5, 10]


def gone_as_one(graph: Graph, lost: np.ndarray) -> tuple[Pose, Pose]:
    """A pose in which all nodes have turned and gone together, and the same with some of them elsewhere."""
    turn = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()
    there = graph.nodes @ turn.T + [0.1, 0.0, 0.2]
    pose = Pose(np.tile(turn, (len(there), 1, 1)), there - graph.nodes)
    wrong = Pose(pose.rotations.copy(), pose.shifts.copy())
    wrong.shifts[lost] += [0.0, 0.0, 0.5]
    return pose, wrong


def test_what_pictures_do_not_show_is_lost_and_carried_along(films: list[CameraFilm]) -> None:
    surface, card = on_cards()
    graph = Graph(surface)
    lost = np.flatnonzero(graph.nodes[:, 0] > CENTRES[1, 0] + 0.15)
    pose, wrong = gone_as_one(graph, lost)
    with ThreadPoolExecutor(1) as pool:
        follower = Follower(graph, films, np.linspace(0.5, 1, 5), Offsets(np.zeros(3), surface.xyz), pool)
        mask = np.isin(np.arange(len(graph.nodes)), lost)
        along = carried(follower.past, wrong, mask, follower.past.poses[0])
        assert np.allclose(along.shifts, pose.shifts) and np.allclose(along.rotations, pose.rotations)
        shots = follower.shots()
        shots.fit(wrong, ((1.2, 0.0),))
        likeness = shots.likeness(wrong)
        assert np.nanmedian(likeness[lost]) < 0.25
        right = shots.likeness(shots.fit(Pose.rest(len(graph.nodes)), FARTHER))
        assert np.nanmedian(right) > 0.5


def test_a_limb_that_is_lost_stays_as_it_was_beside_what_is_around() -> None:
    """An arm that was raised when it was seen last goes on with the trunk, raised; it does not fall to its side."""
    surface, card = on_cards()
    graph = Graph(surface.only(card == 1))
    arm = graph.nodes[:, 0] > CENTRES[1, 0] + 0.15
    raised, (_, went) = Pose.rest(len(arm)), gone_as_one(graph, np.flatnonzero(arm))
    turn = Rotation.from_rotvec([0, 0, 1.0]).as_matrix()
    shoulder = CENTRES[1] + [0.15, 0.0, 0.0]
    raised.rotations[arm] = turn
    raised.shifts[arm] = (graph.nodes[arm] - shoulder) @ turn.T + shoulder - graph.nodes[arm]
    past = Trajectory(graph, np.linspace(0.5, 1, 5))
    past.add(raised, np.zeros(len(arm), dtype=bool))
    past.add(raised, arm)
    found = carried(past, went, arm, past.poses[-1])
    trunk = went.rotations[~arm][0]
    shift = (graph.nodes + went.shifts)[~arm][0] - graph.nodes[~arm][0] @ trunk.T
    there = (graph.nodes + raised.shifts)[arm] @ trunk.T + shift
    assert np.allclose(graph.nodes[arm] + found.shifts[arm], there)
    assert np.allclose(found.rotations[arm], trunk @ turn)


@pytest.mark.parametrize(
    ("gap", "along", "goes"), [(0.1, True, True), (0.1, False, False), (1.0, True, False)]
)
def test_what_hangs_on_nothing_goes_along_with_what_is_near(
    films: list[CameraFilm], gap: float, along: bool, goes: bool
) -> None:
    """A head above a trunk, which it does not touch; not what came from elsewhere, nor what is far."""
    surface, card = on_cards()
    xyz = surface.xyz - CENTRES[card] + np.where(card[:, None] == 1, [2 * SIDE + gap, 0.0, 0.0], 0.0)
    surface = replace(surface, xyz=xyz)
    graph = Graph(surface)
    head = graph.nodes[:, 0] > SIDE + gap / 2
    pose, wrong = gone_as_one(graph, head)
    past = Trajectory(graph, np.linspace(0.5, 1, 5))
    assert len(np.unique(graph.piece)) == 2
    before = Pose(pose.rotations, 0.5 * pose.shifts)
    if not along:
        before.shifts[head] *= -1
    past.add(before, np.zeros(len(head), dtype=bool))
    past.add(before, head)
    found = carried(past, wrong, head, past.poses[0])
    expected = pose if goes else wrong
    assert np.allclose(found.shifts, expected.shifts) and np.allclose(found.rotations, expected.rotations)


def test_what_pictures_seem_to_want_of_lost_points_does_not_pull_what_is_around(
    films: list[CameraFilm], monkeypatch: pytest.MonkeyPatch
) -> None:
    surface, card = on_cards()
    graph = Graph(surface)
    true = true_tracks(surface, card, np.array([0.625]))[0]
    with ThreadPoolExecutor(1) as pool:
        follower = Follower(graph, films, np.linspace(0.5, 1, 5), Offsets(np.zeros(3), surface.xyz), pool)
        lost_nodes = follower.past.lost[-1]
        lost_nodes[:] = graph.nodes[:, 0] > CENTRES[1, 0]
        lost = graph.points_of(lost_nodes)
        assert (believed(graph, lost_nodes) == ~lost).all()
        shots = follower.shots()
        for shot in shots.all:  # of what is lost they show something else
            known = shot.templates
            known.at[lost] = known.at[lost][::-1]
        wrong = []
        for counts in (~lost, None):
            found = shots.fit(Pose.rest(len(graph.nodes)), FARTHER, believed=counts)
            wrong.append(np.linalg.norm(graph.points(found) - true, axis=-1)[(card == 1) & ~lost])
        counted, pulled = (np.quantile(x, 0.9) for x in wrong)
        assert counted < 0.01 < pulled
        fit = Mock(side_effect=Shots.fit)
        monkeypatch.setattr(Shots, "fit", lambda *given, **named: fit(*given, **named))
        follower.go_on()
        assert (fit.call_args_list[0].kwargs["believed"] == ~lost).all()
        assert believed(graph, graph.nodes[:, 0] > 0).all()  # all of a card: nothing hangs on it


def test_what_one_camera_films_alone_goes_on_as_it_went(films: list[CameraFilm]) -> None:
    surface, _ = on_cards()
    graph = Graph(surface)
    short = [films[0], *(replace(f, frames=f.frames[:6], times=f.times[:6]) for f in films[1:])]
    found = follow_both_ways(graph, short, 0.5)[0]
    step_6, step_7 = (np.linalg.norm(found.xyz[n] - found.xyz[n - 1], axis=-1) for n in (REST + 2, REST + 4))
    assert np.median(step_7) == pytest.approx(np.median(step_6), rel=0.1)


class Killed(Exception):
    """In the middle of tracking."""


# of the first run; of the second
@pytest.mark.parametrize("moments", [2, pytest.param(6, marks=pytest.mark.full)])
def test_tracking_that_was_killed_goes_on_where_it_was(
    films: list[CameraFilm],
    tracks: SurfaceTracks,
    moments: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    surface, _ = on_cards()
    checkpoint = Checkpoint(tmp_path / "state.safetensors", "these", every_s=0.0)
    goes = Mock(side_effect=Follower.go_on)
    monkeypatch.setattr(Follower, "go_on", lambda self: goes(self))
    with pytest.raises(Killed):
        kill = Mock(side_effect=[None] * (moments - 1) + [Killed])
        follow_both_ways(Graph(surface), films, 0.5, kill, checkpoint)
    assert goes.call_count == moments
    log = TrainingLog("cpu", 1)
    log.began += 1000  # less than nothing so far: what counts is what was kept
    again, _ = follow_both_ways(Graph(surface), films, 0.5, checkpoint=checkpoint, log=log)
    assert goes.call_count == PICTURES - 1 and 0 < log.seconds < 1000
    assert np.array_equal(again.xyz, tracks.xyz) and np.array_equal(again.lost, tracks.lost)
    follow_both_ways(Graph(surface), films, 0.5, checkpoint=checkpoint)
    assert goes.call_count == PICTURES - 1  # what is done is not done again
    over = Checkpoint(tmp_path / "other.safetensors", "these", until=0.0)
    with pytest.raises(OutOfTime):
        follow_both_ways(Graph(surface), films, 0.5, checkpoint=over)
    assert goes.call_count == PICTURES and over.path is not None and over.path.exists()


@pytest.fixture
def followed(films: list[CameraFilm], monkeypatch: pytest.MonkeyPatch):
    """What following comes to is decided by the test: the likeness of pictures left out, by the first offset."""

    def decide(likeness: Callable[[float], float]) -> list[float]:
        by: list[float] = []

        def both_ways(task, offsets, again):
            by.append(offsets[0] / GAP)
            left_out = CrossValidation()
            for n in range(8):
                left_out.add(0, n, n / 8, np.full(50, likeness(by[-1]) + 0.001 * (n % 2)))
            where = np.tile(task.graph.surface.xyz, (len(task.times), 1, 1))
            lost = np.zeros(where.shape[:2], dtype=bool)
            return _Following(SurfaceTracks(task.times, where, lost, offsets), {}, left_out)

        monkeypatch.setattr(_Task, "both_ways", both_ways)
        return by

    return decide


@pytest.mark.parametrize("gain", [0.1, 0.0, -0.1])
def test_clocks_are_moved_where_cameras_left_out_agree_more(
    films: list[CameraFilm], monkeypatch: pytest.MonkeyPatch, followed, gain: float
) -> None:
    surface, _ = on_cards()
    followed(lambda late: gain * (late > 0))
    monkeypatch.setattr(
        "devrf.reconstruct.tracking.follow.offsets_to_follow", lambda seen, gap: np.array([0.5 * GAP, 0, 0])
    )
    found, (decision,) = follow_both_ways(Graph(surface), films, 0.5)
    assert found.offsets[0] == pytest.approx((0.5 if gain > 0 else 0.0) * GAP)  # as good is not better
    two = ("as they are", f"left {500 * GAP:+.3g} ms")
    assert (decision.chosen, decision.offered) == (two[::-1] if gain > 0 else two)
    assert decision.reason == (
        f"in cameras left out of tracking in turn moved ones gain {gain:+.2f} ± 0.00 likeness"
    )


@pytest.mark.parametrize(
    ("told", "with_which"),
    [
        ([0.5, 0.8], [0.0, 0.5, 0.8]),  # not settled, but enough
        ([0.5, 0.51], [0.0, 0.5]),
        ([0.5, 0.0], [0.0, 0.5]),  # with other clocks they seem to be right
        ([0.0], [0.0]),
    ],
)
def test_everything_is_followed_again_until_offsets_settle(
    films: list[CameraFilm],
    monkeypatch: pytest.MonkeyPatch,
    followed,
    told: list[float],
    with_which: list[float],
) -> None:
    surface, _ = on_cards()
    said, by = iter(told), followed(lambda late: late)
    monkeypatch.setattr(
        "devrf.reconstruct.tracking.follow.offsets_to_follow",
        lambda seen, gap: GAP * np.array([next(said), 0, 0]),
    )
    found, _ = follow_both_ways(Graph(surface), films, 0.5)
    assert by == pytest.approx(with_which)
    assert found.offsets[0] == pytest.approx(with_which[-1] * GAP)  # those that it was followed with


@pytest.mark.parametrize(
    ("sure", "with_which"),
    [((0, 1, 2), [[0, 0, 0]]), ((0,), [[0, 0, 0], [0, -0.5, -0.5]]), ((1, 2), [[0, 0, 0], [0.5, 0, 0]])],
)
def test_clocks_that_are_known_stay(
    films: list[CameraFilm],
    monkeypatch: pytest.MonkeyPatch,
    followed,
    sure: tuple[int, ...],
    with_which: list[list[float]],
) -> None:
    """Tracks say that the first camera is late: as much as that the others are early."""
    surface, _ = on_cards()
    films = [replace(film, sure=n in sure) for n, film in enumerate(films)]
    followed(lambda late: 0.1)
    monkeypatch.setattr(
        "devrf.reconstruct.tracking.follow.offsets_to_follow", lambda seen, gap: np.array([0.5 * GAP, 0, 0])
    )
    asked, both_ways = [], _Task.both_ways

    def spied(task: _Task, offsets: np.ndarray, again: int) -> _Following:
        asked.append(offsets / GAP)
        return both_ways(task, offsets, again)

    monkeypatch.setattr(_Task, "both_ways", spied)
    follow_both_ways(Graph(surface), films, 0.5)
    assert np.allclose(asked, with_which)
    assert [film.backwards().sure for film in films] == [film.sure for film in films]


def test_what_was_left_out_is_kept_and_compared() -> None:
    """Two directions are put together; few points say nothing, and tracks without a picture in common as little."""
    one, other = CrossValidation(), CrossValidation()
    for n in range(16):
        one.add(n % 2, n, n / 16, np.full(30, 0.5 + 0.01 * (n % 4)))
        (other if n < 12 else CrossValidation()).add(n % 2, n, n / 16, np.full(30, 0.2))
    one.add(0, 99, 0.5, np.ones(5))
    assert (0, 99) not in one.pictures
    assert other.gain_over(one).side() == -1 and one.gain_over(other).side() == 1
    assert one.gain_over(other).mean == pytest.approx(0.315)
    again, empty = CrossValidation(), CrossValidation()
    again.take_up(one.state())
    assert again.pictures == one.pictures
    assert empty.gain_over(one).side() == 0 and empty.with_those_of(one).pictures == one.pictures


def test_two_motions_are_two_parts(tracks: SurfaceTracks) -> None:
    surface, card = on_cards()
    labels = rigid_parts(surface.xyz, tracks.xyz, tracks.lost, Graph(surface).links, voxel=0.02)
    assert labels.max() == 1
    assert np.array_equal(labels == labels[0], card == card[0])


@pytest.mark.parametrize("since", [0, 4])  # the first of the moments
def test_what_is_lost_belongs_to_what_it_moved_with_while_it_was_seen(since: int) -> None:
    """The lower half of each card is covered, in all pictures or after some; the guesses of where it is are bad."""
    surface, card = on_cards()
    xyz = true_tracks(surface, card, np.linspace(0.5, 1, 9))
    lost = np.zeros(xyz.shape[:2], dtype=bool)
    lost[since:, surface.xyz[:, 2] < CENTRES[card, 2]] = True
    xyz[lost] += [0.1, 0.0, -0.1]
    links = Graph(surface).links
    labels = rigid_parts(surface.xyz, xyz, lost, links, 0.02)
    assert labels.max() == 1
    assert np.array_equal(labels == labels[0], card == card[0])
    assert rigid_parts(surface.xyz, xyz, np.zeros_like(lost), links, 0.02).max() > 1


def cards_and_wall() -> SurfacePoints:
    """The points on the cards, then those on the wall."""
    cards, _ = on_cards()
    along = np.arange(-0.9, 0.9, SPACING)
    x, z = (grid.ravel() for grid in np.meshgrid(along, along))
    wall = np.stack([x, np.full_like(x, WALL), z], 1)
    xyz = np.concatenate([cards.xyz, wall])
    normals = np.tile([0.0, 1.0, 0.0], (len(xyz), 1))
    return SurfacePoints(xyz, normals, np.concatenate([cards.rgb, np.zeros_like(wall)]), SPACING)


@pytest.mark.parametrize("hues", [True, False], ids=["many hues", "one hue"])
def test_the_wall_stands_and_the_cards_move(films: list[CameraFilm], hues: bool) -> None:
    """Also where all that tells one place of a card from another is that it is a little brighter."""
    if not hues:
        hue = np.array([0.6, 0.9, 0.8])
        films = [
            otherwise(film, lambda _, x: (0.5 + 2 * (x.mean(-1, keepdims=True) - 0.5)).clip(0, 1) * hue)
            for film in films
        ]
    moves, cards = moving_points(cards_and_wall(), films, 0.5), len(on_cards()[0])
    assert moves[:cards].mean() > 0.95 and moves[cards:].mean() < 0.05


def flat(side: int) -> np.ndarray:
    """Points of a level square."""
    along = np.arange(-side // 2, side // 2) * SPACING
    return np.stack([*(grid.ravel() for grid in np.meshgrid(along, along)), np.zeros(side**2)], 1)


def cut(surface: SurfacePoints, votes: np.ndarray) -> np.ndarray:
    return _cut(surface, _links(surface), votes)


def level(xyz: np.ndarray, rgb: np.ndarray | float = 0.4) -> SurfacePoints:
    """A surface of points that all look up."""
    colours = np.broadcast_to(np.asarray(rgb).reshape(-1, 1), xyz.shape)
    return SurfacePoints(xyz, np.tile([0.0, 0.0, 1.0], (len(xyz), 1)), colours, SPACING)


@pytest.mark.parametrize(("height", "moves"), [(1.5 * SPACING, True), (0.0, False)])
def test_a_shoe_does_not_belong_to_the_floor_of_its_colour(height: float, moves: bool) -> None:
    """They have one direction and colour, but lie in two planes; a plate in the floor's own plane belongs to it."""
    floor = flat(40)
    shoe = floor[(np.abs(floor[:, 0]) < 6 * SPACING) & (np.abs(floor[:, 1]) < 4 * SPACING)]
    xyz = np.concatenate([floor, shoe + [SPACING / 2, SPACING / 2, height]])
    found = cut(level(xyz), np.repeat([-0.75, 1.2], [len(floor), len(shoe)]))
    assert (found[len(floor) :] == moves).all() and not found[: len(floor)].any()


@pytest.mark.parametrize(
    ("unlike", "odds", "moves"), [(0.38, 6, True), (0.38, 0.5, False), (0.1, 1.5, False)]
)
def test_a_small_thing_of_another_colour_leaves_the_floor_that_it_lies_on_where_it_surely_went(
    unlike: float, odds: float, moves: bool
) -> None:
    floor = flat(40)
    shoe = (np.abs(floor[:, 0]) < 6 * SPACING) & (np.abs(floor[:, 1]) < 4 * SPACING)
    found = cut(level(floor, np.where(shoe, 0.4 + unlike / np.sqrt(3), 0.4)), np.where(shoe, odds, -6.0))
    assert np.array_equal(found, shoe & moves)


def test_a_brick_does_not_belong_to_the_brick_below() -> None:
    """They have one side in common and unlike colours; the upper one is pushed off."""
    along = np.arange(14) * SPACING
    x, z = (grid.ravel() for grid in np.meshgrid(along, along))
    xyz, upper = np.stack([x, np.zeros_like(x), z], 1), z > 6.5 * SPACING
    rgb = np.where(upper[:, None], [0.7, 0.4, 0.2], [0.4, 0.4, 0.4])
    surface = SurfacePoints(xyz, np.tile([0.0, -1.0, 0.0], (len(xyz), 1)), rgb, SPACING)
    assert np.array_equal(cut(surface, np.where(upper, 3.0, -3.0)), upper)


def test_a_strip_that_looks_as_at_rest_belongs_to_the_sheet_beside_it() -> None:
    """Its colour is not quite the sheet's."""
    x, z = (grid.ravel() for grid in np.meshgrid(np.arange(40) * SPACING, np.arange(14) * SPACING))
    xyz, strip = np.stack([x, np.zeros_like(x), z], 1), x > 19.5 * SPACING
    rgb = np.where(strip[:, None], [0.7, 0.5, 0.5], [0.5, 0.5, 0.5])
    surface = SurfacePoints(xyz, np.tile([0.0, -1.0, 0.0], (len(xyz), 1)), rgb, SPACING)
    assert cut(surface, np.where(strip, -0.6, 3.0)).all()


@pytest.mark.parametrize("odds", [1.0, -1.0])
def test_a_few_points_that_have_no_surroundings_are_what_they_are_found_to_be(odds: float) -> None:
    patch = flat(10)
    surface = level(np.concatenate([patch, patch[:20] + [0, 0, 1]]))
    found = cut(surface, np.repeat([-odds, odds], [100, 20]))
    assert np.array_equal(found, np.repeat([odds < 0, odds > 0], [100, 20]))


def test_planes_are_those_that_hold_much_of_what_stands() -> None:
    """Floor that was not found to stand lies in its plane; a box and its few points make none."""
    floor = flat(40)
    box = floor[(np.abs(floor[:, 0]) < 3 * SPACING) & (np.abs(floor[:, 1]) < 3 * SPACING)] + [0, 0, 0.2]
    stands = np.r_[np.hypot(floor[:, 0], floor[:, 1]) > 8 * SPACING, np.ones(len(box), dtype=bool)]
    found = _in_planes(level(np.concatenate([floor, box])), stands)
    assert found[: len(floor)].all() and not found[len(floor) :].any()
    few = np.arange(len(floor)) < 0.03 * len(floor)  # an edge, while all the rest moves
    assert not _in_planes(level(floor), few).any() and not _in_planes(level(floor), few & False).any()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda x: x, 1),  # it stands
        (lambda x: 0.5 * x, 1),  # it stands in the shade
        (lambda x: np.roll(x, (31, 47), axis=(0, 1)), -1),  # something else with the same colours
    ],
)
def test_a_picture_tells_whether_a_point_is_there(
    films: list[CameraFilm], change: Callable, told: int
) -> None:
    changed = [
        otherwise(film, lambda n, x, f=film: x if n == REST else change(f.picture(REST))) for film in films
    ]
    surface, _ = on_cards()
    seen = likelihoods(surface, changed, 0.5)
    busy = np.linspace(0, 1, seen.known.shape[1])
    moved = seen.known & (np.abs(busy - 0.5) > GAP)[None, :, None]  # not the picture at rest
    sign = np.sign(seen.there - seen.other)[moved]
    assert moved.any() and (sign == told).mean() > 0.85


def test_where_all_looks_alike_a_picture_tells_nothing(films: list[CameraFilm]) -> None:
    plain = [otherwise(film, lambda n, x: np.full_like(x, 0.6)) for film in films]
    seen = likelihoods(on_cards()[0], plain, 0.5)
    assert seen.known.any() and np.abs(seen.there - seen.other).max() < 0.5
    assert not seen.there[~seen.known].any() and not seen.other[~seen.known].any()


def known(there: list[list[float]]) -> Likelihoods:
    """Of one point, by cameras and moments: log-odds for its being there."""
    odds = np.array(there, np.float32)[..., None]
    return Likelihoods(np.maximum(odds, 0), np.maximum(-odds, 0), np.ones_like(odds, dtype=bool))


@pytest.mark.parametrize(
    ("cameras", "moves"),
    [
        ([GONE_LATER, GONE_LATER], True),
        ([GONE_LATER, [0.0] * MOMENTS], True),  # the other camera cannot tell: it has no veto
        ([GONE_LATER, [3.0] * MOMENTS], False),  # the other camera sees it there: it is hidden from the first
        ([[3.0] * MOMENTS, [3.0] * MOMENTS], False),
    ],
)  # fmt: skip
def test_what_moves_is_gone_for_all_cameras_at_once(cameras: list[list[float]], moves: bool) -> None:
    """Beside a point that shows how busy the moments are."""
    one, other = known(cameras), known([GONE_LATER, GONE_LATER])
    both = Likelihoods(*(np.concatenate([getattr(x, f.name) for x in (one, other)], -1) for f in fields(one)))
    assert (_log_odds(both)[0] + PRIOR > 0) == moves


def test_a_point_is_hidden_by_what_is_before_it(films: list[CameraFilm]) -> None:
    film = films[1]
    line = film.camera.centre / np.linalg.norm(film.camera.centre)
    ring = 0.02 * np.stack([np.cos(np.arange(6)), np.zeros(6), np.sin(np.arange(6))], 1)
    xyz = np.concatenate([0.6 * line + ring, 0.1 * line + ring])
    surface = SurfacePoints(xyz, np.tile(line, (12, 1)), np.full_like(xyz, 0.5), 0.1)
    seen = Sight(film, surface).seen
    assert seen[:6].all() and not seen[6:].any()
    assert not Sight(film, replace(surface, normals=-surface.normals)).seen.any()
    behind = replace(film, depth=np.full_like(film.depth, 1.0))
    assert not Sight(behind, surface).seen.any()


def test_a_rigid_pose_moves_points_and_normals_rigidly() -> None:
    surface, _ = on_cards()
    graph = Graph(surface)
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    t = np.array([0.2, -0.1, 0.3])
    pose = Pose(np.tile(R, (len(graph.nodes), 1, 1)), graph.nodes @ R.T + t - graph.nodes)
    assert np.allclose(graph.points(pose), surface.xyz @ R.T + t)
    assert np.allclose(graph.posed(pose).normals, surface.normals @ R.T)
    assert np.allclose(graph.points(Pose.rest(len(graph.nodes))), surface.xyz)


def test_the_graph_does_not_join_what_does_not_touch() -> None:
    surface, card = on_cards()
    graph = Graph(surface)
    links = graph.links.tocoo()
    assert (card[links.row] == card[links.col]).all()
    node_card = (graph.nodes[:, 0] > 0).astype(int)
    assert (node_card[graph.edges[:, 0]] == node_card[graph.edges[:, 1]]).all()


def test_a_step_goes_where_all_points_are_pulled() -> None:
    surface, _ = on_cards()
    graph = Graph(surface)
    pose = Pose.rest(len(graph.nodes))
    goal = surface.xyz + [0.01, 0.02, -0.015]
    for _ in range(3):
        points = graph.points(pose)
        pulls = Pulls(np.tile(1e4 * np.eye(3), (len(points), 1, 1)), 1e4 * (points - goal))
        pose = step(graph, pose, Pose.rest(len(graph.nodes)), pulls)
    assert np.abs(graph.points(pose) - goal).max() < 1e-4


def test_a_step_is_held_to_its_longest() -> None:
    surface, _ = on_cards()
    graph = Graph(surface)
    far = np.zeros_like(surface.xyz) - 1e5
    pulls = Pulls(np.tile(1e4 * np.eye(3), (len(far), 1, 1)), far)
    pose = step(graph, Pose.rest(len(graph.nodes)), Pose.rest(len(graph.nodes)), pulls)
    assert np.abs(pose.shifts).max() == pytest.approx(0.08)


def test_what_goes_far_does_not_shorten_the_steps_of_what_hangs_elsewhere() -> None:
    surface, card = on_cards()
    graph = Graph(surface)
    goal = surface.xyz + np.array([[0.05, 0.0, 0.0], [2.0, 0.0, 0.0]])[card]
    pose = rest = Pose.rest(len(graph.nodes))
    for _ in range(4):
        points = graph.points(pose)
        pose = step(
            graph, pose, rest, Pulls(np.tile(1e4 * np.eye(3), (len(card), 1, 1)), 1e4 * (points - goal))
        )
    gone = (graph.points(pose) - surface.xyz)[:, 0]
    assert gone[card == 0] == pytest.approx(0.05, abs=1e-3)
    assert gone[card == 1] == pytest.approx(4 * 0.08, rel=0.05)


def test_rigid_motions_are_recovered_exactly() -> None:
    rng = np.random.default_rng(3)
    rest = rng.normal(size=(40, 3))
    rotations = Rotation.from_quat(rng.normal(size=(5, 4))).as_matrix()
    shifts = rng.normal(size=(5, 3))
    tracks = np.einsum("tij,pj->tpi", rotations, rest) + shifts[:, None]
    found = motion_of(rest, tracks)
    assert np.allclose(found[0], rotations) and np.allclose(found[1], shifts)
    assert residual(found, rest, tracks).max() < 1e-20
    mirrored = motion_of(rest, tracks * [1, 1, -1])
    assert np.allclose(np.linalg.det(mirrored[0]), 1)


def test_stretches_are_recovered_and_what_is_rigid_has_none() -> None:
    rng = np.random.default_rng(3)
    rest = rng.normal(size=(400, 3))
    rotations = Rotation.from_quat(rng.normal(size=(5, 4))).as_matrix()
    shifts = rng.normal(size=(5, 3))
    stretches = np.eye(3) + np.array([0, 0.05, 0.1, 0.1, 0.2])[:, None, None] * [
        [1, 0.5, 0],
        [0.5, -1, 0],
        [0, 0, 0],
    ]
    tracks = np.einsum("tij,pj->tpi", rotations @ stretches, rest) + shifts[:, None]
    lost = np.zeros(tracks.shape[:2], dtype=bool)
    R, S, t = soft_motion_of(rest, tracks, lost, 0.01)
    assert (
        np.allclose(R, rotations, atol=1e-3)
        and np.allclose(S, stretches, atol=2e-3)
        and np.allclose(t, shifts, atol=2e-3)
    )
    tracks = np.einsum("tij,pj->tpi", rotations, rest) + shifts[:, None]
    assert np.allclose(soft_motion_of(rest, tracks, lost, 0.01)[1], np.eye(3))


def test_a_part_of_which_hardly_anything_is_seen_does_not_stretch() -> None:
    """Some points of a corner are seen, and off; or the part is a sheet, whose thickness nothing tells."""
    rng = np.random.default_rng(4)
    rest = rng.uniform(-1, 1, (300, 3)) * [10, 10, 10]
    tracks = np.tile(rest, (3, 1, 1))
    lost = np.zeros(tracks.shape[:2], dtype=bool)
    corner = (rest > 4).all(1)
    lost[1:, ~corner] = True
    tracks += rng.normal(0, 0.5, tracks.shape)
    lengths = np.linalg.svd(soft_motion_of(rest, tracks, lost, 1.0)[1], compute_uv=False)
    assert np.abs(lengths - 1).max() < 0.1
    sheet = rest * [1, 1, 0.02]
    S = soft_motion_of(
        sheet, np.tile(sheet * [1.1, 1, 1], (3, 1, 1)) + rng.normal(0, 0.5, tracks.shape), lost & False, 1.0
    )[1]
    assert np.allclose(S[:, 0, 0], 1.1, atol=0.03) and np.allclose(S[:, 2, 2], 1, atol=0.05)


def test_more_points_than_a_row_are_looked_up() -> None:
    ramp = np.mgrid[:20, :30][1].astype(np.float32)
    at = np.stack([np.linspace(0, 29, 40_000), np.full(40_000, 7.5)], 1)
    assert np.allclose(fetched(ramp, at), at[:, 0], atol=0.05)
    assert fetched(np.zeros((4, 4, 3)), np.zeros((0, 2))).shape == (0, 3)


def test_time_can_run_backwards(films: list[CameraFilm]) -> None:
    back = films[0].backwards()
    assert np.array_equal(back.times, -films[0].times[::-1])
    assert np.array_equal(back.picture(0), films[0].picture(PICTURES - 1))
    assert back.nearest(-1.0, 0.01) == 0 and back.nearest(-0.44, 0.01) is None


def test_a_camera_that_does_not_film_the_rest_says_nothing_of_what_moves(films: list[CameraFilm]) -> None:
    surface, _ = on_cards()
    late = [replace(film, frames=film.frames[6:], times=film.times[6:]) for film in films]
    assert not moving_points(surface, late, 0.5).any()


def test_pictures_are_read_once_while_they_are_asked_for(films: list[CameraFilm], monkeypatch) -> None:
    read: list[int] = []

    def counted(frame: PosedFrame, *others):
        read.append(frame.index)
        return load_image(frame, *others)

    monkeypatch.setattr("devrf.reconstruct.tracking.views.film.load_image", counted)
    monkeypatch.setattr("devrf.reconstruct.tracking.views.film.PICTURES", 3)
    film = films[0].backwards()
    for n in (0, 1, 0, 2, 0, 3, 0, 4):
        film.picture(n)
    assert read == [PICTURES - 1 - n for n in range(5)]


def otherwise(film: CameraFilm, change: Callable[[int, np.ndarray], np.ndarray]) -> CameraFilm:
    """With what is made of its pictures, by their numbers."""
    pictures = {n: change(n, film.picture(n)) for n in range(len(film.times))}
    eight_bit = {n: (255 * picture).round().astype(np.uint8) for n, picture in pictures.items()}
    return replace(film, _pictures=OrderedDict(eight_bit), _sharp=OrderedDict())


@pytest.mark.parametrize(("colour", "edge_px"), [("grey", 2.0), ("grey", 0.0), ("red", 2.0)])
def test_a_shade_that_crosses_what_stands_moves_nothing(
    films: list[CameraFilm], colour: str, edge_px: float
) -> None:
    """A band that takes half of the light of standing cards and wall; were it red, it would count."""
    takes = np.array([0.5, 0.5, 0.5] if colour == "grey" else [0.0, 0.5, 0.5])

    def shaded(film: CameraFilm, n: int) -> np.ndarray:
        across = np.linspace(0, 1, film.camera.width)
        band = (np.abs(across - n / (PICTURES - 1)) < 0.25) & (n != REST)
        return film.picture(REST) * (1 - gaussian_filter(band.astype(float), edge_px)[:, None] * takes)

    crossed = [otherwise(film, lambda n, _, film=film: shaded(film, n)) for film in films]
    moves = moving_points(cards_and_wall(), crossed, 0.5)
    assert moves.any() == (colour == "red")


def test_a_camera_that_is_bumped_does_not_end_tracking(films: list[CameraFilm]) -> None:
    surface, _ = on_cards()
    K, turn = films[0].camera.K, Rotation.from_rotvec([0, np.radians(2), 0]).as_matrix()
    seen = K @ turn @ np.linalg.inv(K)
    bumped = otherwise(films[0], lambda n, x: cv2.warpPerspective(x, seen, (240, 180)) if n > REST + 1 else x)
    found = follow_both_ways(Graph(surface), [bumped, *films[1:]], 0.5)[0]
    assert found.xyz.shape == (PICTURES, len(surface), 3) and np.isfinite(found.xyz).all()


@pytest.mark.full
def test_a_film_at_half_the_rate_is_followed_as_well(films: list[CameraFilm]) -> None:
    surface, card = on_cards()
    slow = replace(films[0], frames=films[0].frames[::2], times=films[0].times[::2])
    found = follow_both_ways(Graph(surface), [slow, *films[1:]], 0.5)[0]
    assert not found.offsets.any() and np.allclose(found.times, np.linspace(0, 1, PICTURES))
    wrong = np.linalg.norm(found.xyz - true_tracks(surface, card, found.times), axis=-1)
    assert np.median(wrong) < 0.005 and np.percentile(wrong, 95) < 0.02


def test_a_graph_of_one_node_follows_it() -> None:
    surface, _ = on_cards()
    few = surface.only(np.linalg.norm(surface.xyz - CENTRES[0], axis=1) < 2 * SPACING)
    graph, pose, goal = Graph(few), Pose.rest(1), few.xyz + [0.01, 0.02, -0.015]
    assert len(graph.nodes) == 1 and len(few) > 4 and not len(graph.edges)
    for _ in range(3):
        pulls = Pulls(np.tile(1e4 * np.eye(3), (len(few), 1, 1)), 1e4 * (graph.points(pose) - goal))
        pose = step(graph, pose, Pose.rest(1), pulls)
    assert np.abs(graph.points(pose) - goal).max() < 1e-4
