"""An embedded deformation graph: points move with the nodes around them (Sumner et al., SIGGRAPH 2007).

Distances are along the surface and do not cross where two surfaces face each other, so that what touches at rest can
part.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from devrf.reconstruct.tracking.solver.normal_equations import Blocks
from devrf.reconstruct.tracking.surface import SurfacePoints

NODES_APART = 4.5  # spacings of the points
PER_POINT, PER_NODE = 4, 8  # nodes that a point follows; neighbours that a node is held to
LINK = 1.75  # spacings: points nearer than this are neighbours
OPPOSED = -0.2  # cosine of normals below which they are not
SURROUNDING = 8  # nearest points that can be neighbours
FAR = 1e3  # there is no way along the surface


@dataclass(frozen=True)
class Pose:
    """Rotations and translations of nodes: a node at g goes to g + t, what is around it turns by R."""

    rotations: Float[np.ndarray, "n 3 3"]
    shifts: Float[np.ndarray, "n 3"]

    @staticmethod
    def rest(nodes: int) -> "Pose":
        """Nothing has moved."""
        return Pose(np.tile(np.eye(3), (nodes, 1, 1)), np.zeros((nodes, 3)))

    def with_nodes(self, nodes: Int[np.ndarray, " k"], other: "Pose") -> "Pose":
        """The same, but some nodes as in another pose."""
        rotations, shifts = self.rotations.copy(), self.shifts.copy()
        rotations[nodes], shifts[nodes] = other.rotations[nodes], other.shifts[nodes]
        return Pose(rotations, shifts)


class Graph:
    """Nodes, and how points follow them.

    Attributes:
        surface: The points.
        nodes: Positions at rest [n, 3].
        edges: Neighbours, both ways [e, 2].
        edge: Mean length of these.
        followed, weights: Nodes of each point, and how much it follows them [p, k].
        links: Neighbouring points, weighted by distance (sparse, symmetric).
        piece: Number of what hangs together by edges, of each node [n].
        blocks: Of the matrix of a step of all nodes.
    """

    def __init__(self, surface: SurfacePoints, seed: int = 0) -> None:
        xyz, spacing = surface.xyz, surface.spacing
        self.surface, self.links = surface, _links(surface)
        chosen = _cover(xyz, NODES_APART * spacing, np.random.default_rng(seed).permutation(len(xyz)))
        self.nodes: Float[np.ndarray, "n 3"] = xyz[chosen]
        along = dijkstra(self.links, directed=False, indices=chosen, limit=5 * NODES_APART * spacing)
        along = np.where(np.isfinite(along), along, FAR)
        lost = (along >= FAR).all(0)
        along[:, lost] = np.linalg.norm(xyz[None, lost] - self.nodes[:, None], axis=-1)
        k = min(PER_POINT, len(chosen))
        order = np.argsort(along, axis=0)[: k + 1].T
        distance = np.take_along_axis(along, order.T, 0).T
        self.followed: Int[np.ndarray, "p k"] = order[:, :k]
        weights = np.maximum(0, 1 - distance[:, :k] / np.maximum(distance[:, -1:], 1e-6)) ** 2
        weights = np.where(distance[:, :k] < FAR / 2, weights, 0) + 1e-9
        self.weights: Float[np.ndarray, "p k"] = weights / weights.sum(1, keepdims=True)
        self.offsets: Float[np.ndarray, "p k 3"] = xyz[:, None] - self.nodes[self.followed]
        self.edges = self._edges(along[:, chosen])
        a, b = self.nodes[self.edges].transpose(1, 0, 2)
        self.edge = float(np.linalg.norm(b - a, axis=1).mean()) if len(a) else 0.0
        self.piece: Int[np.ndarray, " n"] = pieces(self.edges, len(self.nodes))
        self.blocks = Blocks.of(self.followed, self.edges, len(self.nodes))
        one = np.ones((*self.followed.shape, 1))
        self._follow = self._sums(self.weights[..., None] * one)
        self._places = self._sums(self.weights[..., None] * np.concatenate([self.offsets, one], axis=2))

    def _sums(self, values: Float[np.ndarray, "p k c"]) -> csr_matrix:
        """Matrix of sums over the nodes that each point follows, of c rows of each node."""
        columns = values.shape[2]
        at = self.followed[..., None] * columns + np.arange(columns)
        rows = np.broadcast_to(np.arange(len(values))[:, None, None], at.shape)
        shape = len(values), columns * len(self.nodes)
        return csr_matrix((values.ravel(), (rows.ravel(), at.ravel())), shape=shape)

    def _edges(self, along: Float[np.ndarray, "n n"]) -> Int[np.ndarray, "e 2"]:
        n = len(self.nodes)
        near = np.argsort(along, axis=1)[:, 1 : PER_NODE + 1]
        rows, columns = np.repeat(np.arange(n), near.shape[1]), near.ravel()
        reached = along[rows, columns] < FAR / 2
        pairs = np.stack([rows[reached], columns[reached]], 1)
        alone = np.setdiff1d(np.arange(n), pairs)
        if len(alone) and n > 1:
            beside = np.asarray(KDTree(self.nodes).query(self.nodes[alone], k=min(4, n))[1])[:, 1:]
            pairs = np.vstack([pairs, np.stack([np.repeat(alone, beside.shape[1]), beside.ravel()], 1)])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        return np.vstack([pairs, pairs[:, ::-1]])

    def moved(self, pose: Pose, turn: Float[np.ndarray, "n 3"], shift: Float[np.ndarray, "n 3"]) -> Pose:
        """The pose after each node turned by a rotation vector, and was shifted."""
        return Pose(Rotation.from_rotvec(turn).as_matrix() @ pose.rotations, pose.shifts + shift)

    def points(self, pose: Pose) -> Float[np.ndarray, "p 3"]:
        """Where all points are."""
        there = np.concatenate([pose.rotations.mT, (self.nodes + pose.shifts)[:, None]], axis=1)
        return self._places @ there.reshape(-1, 3)

    def posed(self, pose: Pose) -> SurfacePoints:
        """The surface where it is."""
        turns = (self._follow @ pose.rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        normals = np.einsum("pij,pj->pi", turns, self.surface.normals)
        return replace(self.surface, xyz=self.points(pose), normals=normals)

    def points_of(self, nodes: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " p"]:
        """Points that mostly follow some nodes."""
        return (self.weights * nodes[self.followed]).sum(1) > 0.5

    def groups(self, nodes: Bool[np.ndarray, " n"]) -> Iterator[Int[np.ndarray, " k"]]:
        """Some nodes, those that are neighbours together."""
        piece = pieces(self.edges[nodes[self.edges].all(1)], len(nodes))
        for number in np.unique(piece[nodes]):
            yield np.flatnonzero(nodes & (piece == number))

    def around(self, nodes: Int[np.ndarray, " k"], rings: int) -> Bool[np.ndarray, " n"]:
        """Nodes within so many edges of some nodes, and these."""
        a, b = self.edges.T
        near = np.isin(np.arange(len(self.nodes)), nodes)
        for _ in range(rings):
            near[b[near[a]]] = True
        return near


def pieces(pairs: Int[np.ndarray, "k 2"], number: int) -> Int[np.ndarray, " n"]:
    """The number of the piece of each of so many things, where pairs hang together."""
    links = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(number, number))
    return connected_components(links, directed=False)[1]


def _links(surface: SurfacePoints) -> csr_matrix:
    """Neighbouring points, with their distances."""
    n = len(surface)
    k = min(SURROUNDING, n - 1)
    distance, near = map(np.asarray, KDTree(surface.xyz).query(surface.xyz, k=k + 1))
    rows, columns, apart = np.repeat(np.arange(n), k), near[:, 1:].ravel(), distance[:, 1:].ravel()
    alike = (surface.normals[rows] * surface.normals[columns]).sum(1) > OPPOSED
    kept = (apart < LINK * surface.spacing) & alike
    links = csr_matrix((apart[kept], (rows[kept], columns[kept])), shape=(n, n))
    return csr_matrix(links.maximum(links.T))


def _cover(
    xyz: Float[np.ndarray, "p 3"], radius: float, order: Int[np.ndarray, " p"]
) -> Int[np.ndarray, " n"]:
    """Points such that every point has one of them within a radius, taken in an order."""
    tree, left, out = KDTree(xyz), np.ones(len(xyz), dtype=bool), []
    for n in order.tolist():
        if left[n]:
            out.append(n)
            left[tree.query_ball_point(xyz[n], radius)] = False
    return np.array(out)
