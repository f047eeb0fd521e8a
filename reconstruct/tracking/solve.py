"""One Gauss-Newton step of the graph: what pictures say, as rigid as possible, not far from what was expected."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from devrf.reconstruct.tracking.graph import Graph, Pose, skew

RIGID = 1e3  # weight of edges that stretch or bend, per squared relative length
TEARS = 0.3  # relative stretch at which an edge counts half: what only touches at rest parts, and skin at a joint holds
EXPECTED = 0.01  # weight of the expected pose, per squared box unit and radian
DAMPED, LEAST = 1e-3, 1e-2  # of the diagonal; added to it
LONGEST_STEP, LARGEST_TURN = 0.08, 0.5  # box units, radians


class Pulls(NamedTuple):
    """What pictures want of all points: the quadratic x^T H x / 2 + b^T x of their moves; 0 where nothing is wanted."""

    hessian: Float[np.ndarray, "p 3 3"]
    gradient: Float[np.ndarray, "p 3"]


def step(graph: Graph, pose: Pose, expected: Pose, pulls: Pulls) -> Pose:
    """The pose after one step."""
    terms = [_data(graph, pose, pulls), _rigid(graph, pose), _expected(pose, expected)]
    A = csc_matrix(sum(csc_matrix(J.T @ J) for J, _ in terms))
    b = np.sum([J.T @ residual for J, residual in terms], axis=0)
    if not np.array_equal(graph.parts, np.arange(len(graph.nodes))):  # else each node moves by itself
        by_parts = graph.by_parts(pose)
        A, b = csc_matrix(by_parts.T @ A @ by_parts), by_parts.T @ b
    A.setdiag(A.diagonal() * (1 + DAMPED) + LEAST)
    # Positive definite, and parts meet only their neighbours: no pivots, few of the zeros are filled.
    factors = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    move = _shortened(factors.solve(-b).reshape(-1, 6), graph.pieces())
    return graph.moved(pose, move[:, :3], move[:, 3:])


def _shortened(move: Float[np.ndarray, "m 6"], piece: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 6"]:
    """Turns and shifts of parts, each piece's by its own largest: what flies off does not hold back what it left."""
    largest = np.abs(move / np.repeat([LARGEST_TURN, LONGEST_STEP], 3)).max(1)
    too_far = np.ones(piece.max() + 1)
    np.maximum.at(too_far, piece, largest)
    return move / too_far[piece, None]


Term = tuple[bsr_matrix, np.ndarray]
"""Residuals [r], and their derivative by small rotations and shifts of the nodes [r, 6 n]."""


def _data(graph: Graph, pose: Pose, pulls: Pulls) -> Term:
    """The points' quadratics: three residuals a point, by the root of its Hessian."""
    trace = np.trace(pulls.hessian, axis1=1, axis2=2)
    points = np.flatnonzero(trace > 1e-6)
    root = np.linalg.cholesky(pulls.hessian[points] + np.eye(3) * (1e-6 * trace[points, None, None] + 1e-9))
    residual = np.linalg.solve(root, pulls.gradient[points][..., None])[..., 0]
    by_node = root.mT[:, None] @ graph.derivative(pose, points)
    return _term(by_node, graph.followed[points], len(graph.nodes), residual)


def _rigid(graph: Graph, pose: Pose) -> Term:
    """Edges between parts as they were at rest, turned with their first node."""
    edges = graph.edges[np.diff(graph.parts[graph.edges]).any(1)]
    a, b = edges.T
    edge = graph.nodes[b] - graph.nodes[a]
    turned = np.einsum("eij,ej->ei", pose.rotations[a], edge)
    residual = turned + graph.nodes[a] + pose.shifts[a] - graph.nodes[b] - pose.shifts[b]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    stretch = np.linalg.norm(edge + pose.shifts[b] - pose.shifts[a], axis=1, keepdims=True) / length - 1
    root = np.sqrt(RIGID / (1 + (stretch / TEARS) ** 2)) / length
    by_node = np.zeros((len(edges), 2, 3, 6))
    by_node[:, 0, :, :3] = -skew(turned)
    by_node[:, 0, :, 3:], by_node[:, 1, :, 3:] = np.eye(3), -np.eye(3)
    return _term(by_node * root[:, None, None], edges, len(graph.nodes), residual * root)


def _expected(pose: Pose, expected: Pose) -> Term:
    """Nodes near where they were expected."""
    turn = Rotation.from_matrix(pose.rotations @ expected.rotations.transpose(0, 2, 1)).as_rotvec()
    residual, root = np.concatenate([turn, pose.shifts - expected.shifts], axis=1), np.sqrt(EXPECTED)
    nodes = np.arange(len(residual))
    by_node = np.broadcast_to(root * np.eye(6), (len(nodes), 1, 6, 6))
    return _term(by_node, nodes[:, None], len(nodes), residual * root)


def _term(
    by_node: Float[np.ndarray, "m k s 6"],
    node: Int[np.ndarray, "m k"],
    nodes: int,
    residual: Float[np.ndarray, "m s"],
) -> Term:
    """Of m groups of residuals, each of which depends on k nodes."""
    m, k, size, _ = by_node.shape
    blocks = (by_node.reshape(-1, size, 6), node.ravel(), np.arange(0, m * k + 1, k))
    return bsr_matrix(blocks, shape=(size * m, 6 * nodes)), residual.ravel()
