"""A limb that is lost and contradicted is found where pictures show it turned about its joint."""

from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.reconstruct.conftest import look_at

from devrf.capture.camera import Camera
from devrf.flow.dis import DisFlow
from devrf.reconstruct.tracking.lost.joint_search import evenly, score, turn_limbs, view_without
from devrf.reconstruct.tracking.pose import Estimate, Shots
from devrf.reconstruct.tracking.solver.graph import Graph, Pose
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.trajectory import Trajectory
from devrf.reconstruct.tracking.views.film import CameraFilm
from devrf.reconstruct.tracking.views.sight import Sight
from devrf.reconstruct.tracking.views.templates import Templates

SPACING, RADIUS = 0.025, 0.07
JOINT = np.array([0.0, 0.0, 0.0])
TURN = Rotation.from_rotvec([0.0, -1.6, 0.5]).as_matrix()  # by 96 degrees


def tube(start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a tube along x, and their normals."""
    around = np.arange(0, 2 * np.pi, SPACING / RADIUS)
    x, angle = (grid.ravel() for grid in np.meshgrid(np.arange(start, end, SPACING), around))
    normals = np.stack([np.zeros_like(x), np.cos(angle), np.sin(angle)], 1)
    return np.stack([x, RADIUS * normals[:, 1], RADIUS * normals[:, 2]], 1), normals


@pytest.fixture(scope="module")
def arm() -> tuple[Graph, np.ndarray]:
    """An upper arm and a forearm in one line, painted so that every turn looks different; points of the latter."""
    parts = [tube(-0.5, 0.0), tube(0.0, 0.5)]
    xyz, normals = (np.concatenate(x) for x in zip(*parts, strict=True))
    sides = 0.5 + 0.4 * normals[:, 1:]
    rgb = np.column_stack([np.where(xyz[:, 0] < 0, 0.2, 0.8), sides]) * (0.7 + 0.5 * np.abs(xyz[:, :1]))
    graph = Graph(SurfacePoints(xyz, normals, rgb, SPACING))
    return graph, np.arange(len(xyz)) >= len(parts[0][0])


def film(eye: tuple[float, float, float], *shown: SurfacePoints) -> CameraFilm:
    """A camera before a grey wall, and its pictures of surfaces."""
    camera = replace(
        look_at(np.array(eye)), width=240, height=180, K=np.array([[200.0, 0, 120], [0, 200, 90], [0, 0, 1]])
    )
    plate, far = np.full((180, 240, 3), 0.5, np.float32), np.full((180, 240), np.inf)
    out = CameraFilm(camera, [], np.array([0.0, 1.0]), 1.0, "shell", DisFlow(), far, plate)
    pictures = OrderedDict[int, np.ndarray]()
    for n, surface in enumerate(shown):
        ids = Sight(out, surface).ids
        picture = np.where(ids[..., None] >= 0, surface.rgb[ids], plate)
        pictures[n] = np.round(255 * picture).astype(np.uint8)
    return replace(out, _pictures=pictures)


def filmed(rest: SurfacePoints, shown: SurfacePoints) -> list[CameraFilm]:
    """Four cameras that see it at rest, and then in another way."""
    eyes = (0.0, 2.0, 0.8), (1.6, 1.4, 0.2), (-1.6, 1.4, 0.4), (0.3, -2.0, 0.5)
    return [film(eye, rest, shown) for eye in eyes]


def nodes_beyond_joint(graph: Graph) -> np.ndarray:
    return graph.nodes[:, 0] > 0.03


def estimate(graph: Graph, films: list[CameraFilm], lost: np.ndarray) -> tuple[Shots, Estimate]:
    """Everything at rest, some of it lost."""
    past = Trajectory(graph, np.array([0.0, 1.0]))
    templates = [Templates(one, len(graph.surface)) for one in films]
    for known in templates:
        known.learn(0, Sight(known.film, graph.surface), 1)
    shots = Shots(past, templates, np.zeros(len(films)), ThreadPoolExecutor(1))
    liked = np.where(lost, -0.8, 1.0)
    return shots, Estimate(past.poses[0], lost, liked)


def turned(surface: SurfacePoints, points: np.ndarray) -> SurfacePoints:
    """The surface with its forearm turned about the joint."""
    xyz, normals = surface.xyz.copy(), surface.normals.copy()
    xyz[points], normals[points] = (xyz[points] - JOINT) @ TURN.T + JOINT, normals[points] @ TURN.T
    return replace(surface, xyz=xyz, normals=normals)


def test_a_forearm_that_comes_back_turned_is_found(arm: tuple[Graph, np.ndarray]) -> None:
    graph, forearm = arm
    true = turned(graph.surface, forearm)
    lost = nodes_beyond_joint(graph)
    shots, found = estimate(graph, filmed(graph.surface, true), lost)
    turn_limbs(shots, found)
    beyond = forearm & (graph.surface.xyz[:, 0] > 0.1)
    before = np.linalg.norm(graph.surface.xyz - true.xyz, axis=1)[beyond].mean()
    off = np.linalg.norm(graph.points(found.pose) - true.xyz, axis=1)[beyond].mean()
    assert off < 0.15 < 0.4 < before  # a rotation among those tried, not yet followed
    assert np.array_equal(found.pose.shifts[~lost], np.zeros((int((~lost).sum()), 3)))


def test_what_pictures_do_not_contradict_stays(arm: tuple[Graph, np.ndarray]) -> None:
    graph, _ = arm
    shots, found = estimate(graph, filmed(graph.surface, graph.surface), nodes_beyond_joint(graph))
    turn_limbs(shots, found)
    assert not found.pose.shifts.any()


def test_a_limb_that_no_picture_shows_is_not_put_anywhere(arm: tuple[Graph, np.ndarray]) -> None:
    graph, forearm = arm
    shots, found = estimate(
        graph, filmed(graph.surface, graph.surface.only(~forearm)), nodes_beyond_joint(graph)
    )
    turn_limbs(shots, found)
    assert not found.pose.shifts.any()


def test_half_of_a_ball_does_not_turn_about_the_other_half() -> None:
    n = np.arange(900)  # evenly on a sphere, red on one side of a seam and green on the other
    up, around = 1 - 2 * (n + 0.5) / len(n), 2.39996 * n
    normals = np.column_stack([np.cos(around) * np.sqrt(1 - up**2), np.sin(around) * np.sqrt(1 - up**2), up])
    rgb = np.where(normals[:, 1:2] > 0, [0.9, 0.2, 0.2], [0.2, 0.9, 0.2])
    graph = Graph(SurfacePoints(0.3 * normals, normals, rgb, SPACING))
    turn = Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix()
    true = replace(graph.surface, xyz=graph.surface.xyz @ turn.T, normals=normals @ turn.T)
    shots, found = estimate(graph, filmed(graph.surface, true), graph.nodes[:, 0] > 0)
    turn_limbs(shots, found)
    assert not found.pose.shifts.any()


def test_scores_tell_a_limb_from_what_stands(arm: tuple[Graph, np.ndarray]) -> None:
    graph, forearm = arm
    true, surface = turned(graph.surface, forearm), graph.surface
    shots, found = estimate(graph, filmed(graph.surface, true), nodes_beyond_joint(graph))
    views = [view_without(shot, surface, forearm) for shot in shots.all]
    there = np.stack([surface.xyz[forearm], true.xyz[forearm]])
    normals = np.stack([surface.normals[forearm], true.normals[forearm]])
    at_rest, right = score(views, there, normals, surface.rgb[forearm].astype(np.float32))
    assert at_rest < -0.5 and right > 0.8
    assert isinstance(views[0].camera, Camera) and isinstance(found.pose, Pose)


def test_rotations_are_spread_evenly() -> None:
    turns = evenly(300)
    assert np.allclose(turns @ turns.mT, np.eye(3)) and np.allclose(np.linalg.det(turns), 1)
    every = Rotation.random(200, np.random.default_rng(0)).as_matrix()
    cosine = (np.einsum("aij,bij->ab", every, turns) - 1) / 2
    assert np.degrees(np.arccos(cosine.max(1).clip(-1, 1))).max() < 40
