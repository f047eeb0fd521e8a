"""Where a limb may be that comes back turned: rotated about its joint to where pictures show its colours.

A forearm that was hidden behind a back lies beside its neighbours neither as before nor as at rest, and flow knows
nothing of it. Where pictures clearly show something else in its place, all rotations about the joint are held against
the cameras' colours (`score`); the best are what tracking goes on from.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.transform import Rotation

from devrf.capture.camera import Camera
from devrf.reconstruct.tracking.pose import FARTHER, Estimate, Shots
from devrf.reconstruct.tracking.solver.graph import Graph, Pose
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.views.film import Picture, blurred, sampled
from devrf.reconstruct.tracking.views.shot import Shot
from devrf.reconstruct.tracking.views.sight import BEHIND, Sight, depth_of, faces

ROTATIONS = 300  # 30 degrees apart: a fit comes from there
TRIED = 4  # of them, those with the best colours
# Scores: below the first pictures contradict a place, what is only hidden or a little off has more; above the second
# they show the limb: a forearm had 0.3 to 0.8 at its true place, where it was seen.
CONTRADICTED, SHOWN = -0.2, 0.25
FEWEST_NODES = 5  # of a limb; fewer are skin at a joint
MOST_POINTS = 300  # of a limb that are looked at
BLUR_PX = 2.0  # of the colours
TELLING = 0.08  # difference between a point's colour and what stands behind that counts as one


class ViewWithout(NamedTuple):
    """What one camera shows: its picture, what it should be without what is lost, and the depth of the latter."""

    camera: Camera
    picture: Picture
    without: Picture
    depth: Float[np.ndarray, "h w"]


class _Limb:
    """Nodes that are lost together, their points, and those of these that are looked at."""

    def __init__(self, graph: Graph, nodes: Int[np.ndarray, " k"]) -> None:
        self.graph, self.nodes = graph, nodes
        self.mine = np.isin(np.arange(len(graph.nodes)), nodes)
        self.points = graph.points_of(self.mine)
        counted = np.cumsum(self.points) - 1
        self.looked_at = self.points & (counted % (1 + max(counted[-1], 0) // MOST_POINTS) == 0)
        self.rgb = graph.surface.rgb[self.looked_at].astype(np.float32)

    def score(self, views: list[ViewWithout], surface: SurfacePoints) -> float:
        """How much pictures show of it, where the surface is."""
        there = surface.only(self.looked_at)
        return float(score(views, there.xyz[None], there.normals[None], self.rgb)[0])

    def joint(self, lost: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
        """Nodes beside it that are not lost, if it is longer than these lie apart: what is as wide as long, half of a
        ball, does not turn about the rest. None of something by itself."""
        nodes, (a, b) = self.graph.nodes, self.graph.edges.T
        holds = np.unique(b[self.mine[a] & ~lost[b]])
        if not len(holds):
            return holds
        centre = nodes[holds].mean(0)
        length, radius = (np.linalg.norm(nodes[of] - centre, axis=1).max() for of in (self.nodes, holds))
        return holds if length > 2 * radius else holds[:0]

    def turned(self, views: list[ViewWithout], pose: Pose, lost: Bool[np.ndarray, " n"]) -> list[Pose]:
        """Poses with the limb as at rest, but turned about its joint, the likeliest first; none if it has no joint."""
        graph, holds = self.graph, self.joint(lost)
        if not len(holds):
            return []
        rest = graph.nodes[holds].mean(0)
        joint, turns = rest + pose.shifts[holds].mean(0), evenly(ROTATIONS)
        surface = graph.surface.only(self.looked_at)
        xyz = np.einsum("tij,pj->tpi", turns, surface.xyz - rest) + joint
        found = score(views, xyz, np.einsum("tij,pj->tpi", turns, surface.normals), self.rgb)
        out = []
        for turn in turns[np.argsort(-found, kind="stable")[:TRIED]]:
            rotations, shifts = pose.rotations.copy(), pose.shifts.copy()
            rotations[self.nodes] = turn
            shifts[self.nodes] = (graph.nodes[self.nodes] - rest) @ turn.T + joint - graph.nodes[self.nodes]
            out.append(Pose(rotations, shifts))
        return out


def turn_limbs(shots: Shots, found: Estimate) -> None:
    """Where pictures contradict a lost limb, change the estimate where they show it turned about its joint."""
    graph, lost = shots.graph, found.lost
    limbs = [_Limb(graph, nodes) for nodes in graph.groups(lost) if len(nodes) >= FEWEST_NODES]
    if not limbs or lost.all():
        return
    surface, hidden = graph.posed(found.pose), graph.points_of(lost)
    views = [view_without(shot, surface, hidden) for shot in shots.all]
    for limb in limbs:
        if limb.score(views, surface) >= CONTRADICTED:
            continue
        best = SHOWN
        for turned in limb.turned(views, found.pose, lost):
            fitted = shots.fit(turned, FARTHER, limb.points)
            pose = found.pose.with_nodes(limb.nodes, fitted)
            if (shown := limb.score(views, graph.posed(pose))) > best:
                best, found.pose = shown, pose
                found.likeness[limb.nodes] = shots.likeness(pose)[limb.nodes]
    found.see(found.likeness)


def score(
    views: list[ViewWithout],
    xyz: Float[np.ndarray, "t p 3"],
    normals: Float[np.ndarray, "t p 3"],
    rgb: Float32[np.ndarray, "p 3"],
) -> Float[np.ndarray, " t"]:
    """How much pictures show of points at places, against what stands there: of a point and camera that sees it from 1,
    its colour, to -1, what stands; the sum over cameras, the mean over points."""
    tried, number = xyz.shape[:2]
    out, xyz, normals = np.zeros(tried), xyz.reshape(-1, 3), normals.reshape(-1, 3)
    for view in views:
        camera = view.camera
        at, z = camera.project(xyz), depth_of(camera, xyz)
        seen = np.flatnonzero(camera.in_picture(at) & (z > 0) & faces(camera, xyz, normals))
        x, y = at[seen].astype(int).T
        seen = seen[z[seen] < view.depth[y, x] + BEHIND]
        look = rgb[seen % number]
        real, behind = sampled(view.picture, at[seen]), sampled(view.without, at[seen])
        apart = np.linalg.norm(look - behind, axis=1)
        vote = np.linalg.norm(real - behind, axis=1) - np.linalg.norm(real - look, axis=1)
        np.add.at(out, seen // number, (vote / np.maximum(apart, TELLING)).clip(-1, 1))
    return out / max(number, 1)


def evenly(number: int) -> Float[np.ndarray, "t 3 3"]:
    """Rotations spread evenly over all (super-Fibonacci spirals: Alexa, CVPR 2022)."""
    share = (np.arange(number) + 0.5) / number
    a, b = (2 * np.pi * number * share / c for c in (2**0.5, 1.533751168755204288118041))
    r, s = np.sqrt(share), np.sqrt(1 - share)
    return Rotation.from_quat(
        np.stack([r * np.sin(a), r * np.cos(a), s * np.sin(b), s * np.cos(b)], 1)
    ).as_matrix()


def view_without(shot: Shot, surface: SurfacePoints, lost: Bool[np.ndarray, " p"]) -> ViewWithout:
    """What a camera shows of a moment, beside what it should without some of the points."""
    film = shot.film
    sight = Sight(film, replace(surface, xyz=np.where(lost[:, None], np.nan, surface.xyz)))
    drawn = shot.templates.draw(sight, surface.rgb.astype(np.float32))
    picture, without = (blurred(x, BLUR_PX) for x in (film.picture(shot.n), drawn))
    return ViewWithout(film.camera, picture, without, sight.depth)
