"""One Gauss-Newton step of the graph: what pictures say, as rigid as possible, not far from what was expected."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.sparse import csc_matrix, csr_matrix
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
    nodes = len(graph.nodes)
    rows, columns, values, residuals = _data(graph, pose, pulls)
    first = len(residuals)
    for part in (_rigid(graph, pose), _expected(pose, expected)):
        rows.append(part[0] + first)
        columns.append(part[1])
        values.append(part[2])
        residuals = np.concatenate([residuals, part[3]])
        first = len(residuals)
    J = csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(first, 6 * nodes)
    )
    J = csr_matrix(J @ graph.by_parts(pose))
    A = csc_matrix(J.T @ J)
    A.setdiag(A.diagonal() * (1 + DAMPED) + LEAST)
    # Positive definite, and parts meet only their neighbours: no pivots, few of the zeros are filled.
    factors = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    move = factors.solve(-(J.T @ residuals)).reshape(-1, 6)
    turn, shift = move[:, :3], move[:, 3:]
    too_far = max(1.0, np.abs(shift).max() / LONGEST_STEP, np.abs(turn).max() / LARGEST_TURN)
    return graph.moved(pose, turn / too_far, shift / too_far)


def _data(
    graph: Graph, pose: Pose, pulls: Pulls
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Rows of the points' quadratics: three a point, by the root of its Hessian."""
    trace = np.trace(pulls.hessian, axis1=1, axis2=2)
    points = np.flatnonzero(trace > 1e-6)
    root = np.linalg.cholesky(pulls.hessian[points] + np.eye(3) * (1e-6 * trace[points, None, None] + 1e-9))
    residual = np.linalg.solve(root, pulls.gradient[points][..., None])[..., 0]
    by_node = np.einsum("pji,pkjc->pikc", root, graph.derivative(pose, points))  # the transposed root
    row = np.arange(3 * len(points)).reshape(-1, 3)
    column = 6 * graph.followed[points][:, :, None] + np.arange(6)
    rows = np.broadcast_to(row[:, :, None, None], by_node.shape).ravel()
    columns = np.broadcast_to(column[:, None], by_node.shape).ravel()
    return [rows], [columns], [by_node.ravel()], residual.ravel()


def _rigid(graph: Graph, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Edges between parts as they were at rest, turned with their first node."""
    a, b = graph.edges[np.diff(graph.parts[graph.edges]).any(1)].T
    edge = graph.nodes[b] - graph.nodes[a]
    turned = np.einsum("eij,ej->ei", pose.rotations[a], edge)
    residual = turned + graph.nodes[a] + pose.shifts[a] - graph.nodes[b] - pose.shifts[b]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    stretch = np.linalg.norm(edge + pose.shifts[b] - pose.shifts[a], axis=1, keepdims=True) / length - 1
    root = np.sqrt(RIGID / (1 + (stretch / TEARS) ** 2)) / length
    row = np.arange(3 * len(a)).reshape(-1, 3)
    by_turn = -skew(turned) * root[..., None]
    rows, columns, values = (
        [np.broadcast_to(row[:, :, None], by_turn.shape).ravel()],
        [np.broadcast_to(6 * a[:, None, None] + np.arange(3), by_turn.shape).ravel()],
        [by_turn.ravel()],
    )
    for node, sign in ((a, 1.0), (b, -1.0)):
        rows.append(row.ravel())
        columns.append((6 * node[:, None] + 3 + np.arange(3)).ravel())
        values.append(np.broadcast_to(sign * root, row.shape).ravel())
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values), (residual * root).ravel()


def _expected(pose: Pose, expected: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes near where they were expected."""
    turn = Rotation.from_matrix(pose.rotations @ expected.rotations.transpose(0, 2, 1)).as_rotvec()
    residual = np.concatenate([turn, pose.shifts - expected.shifts], axis=1).ravel()
    number, root = np.arange(residual.size), np.sqrt(EXPECTED)
    return number, number, np.full(residual.size, root), residual * root
