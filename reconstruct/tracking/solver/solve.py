"""One Gauss-Newton step of the graph: what pictures say, as rigid as possible, not far from what was expected."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from devrf.reconstruct.tracking.solver.graph import Graph, Pose
from devrf.reconstruct.tracking.solver.normal_equations import Pulls, edge_terms, point_terms, skew

RIGID = 1e3  # weight of edges that stretch or bend, per squared relative length
TEARS = 0.3  # relative stretch at which an edge counts half: what only touches at rest parts, and skin at a joint holds
EXPECTED = 0.01  # weight of the expected pose, per squared box unit and radian
DAMPED, LEAST = 1e-3, 1e-2  # of the diagonal; added to it
LONGEST_STEP, LARGEST_TURN = 0.08, 0.5  # box units, radians


def step(graph: Graph, pose: Pose, expected: Pose, pulls: Pulls) -> Pose:
    """The pose after one step."""
    blocks, b = point_terms(graph.blocks, pose.rotations, graph.followed, graph.offsets, graph.weights, pulls)
    of_edges, of_nodes = _rigid(graph, pose)
    blocks += of_edges
    b += of_nodes + EXPECTED * _away(pose, expected)
    blocks[graph.blocks.of_node] += EXPECTED * np.eye(6)
    A = graph.blocks.matrix(blocks)
    A.setdiag(A.diagonal() * (1 + DAMPED) + LEAST)
    # Positive definite, and nodes meet only their neighbours: no pivots, few of the zeros are filled.
    factors = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    move = _shortened(factors.solve(-b).reshape(-1, 6), graph.piece)
    return graph.moved(pose, move[:, :3], move[:, 3:])


def _shortened(move: Float[np.ndarray, "m 6"], piece: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 6"]:
    """Turns and shifts of nodes, each piece's by its own largest: what flies off does not hold back what it left."""
    largest = np.abs(move / np.repeat([LARGEST_TURN, LONGEST_STEP], 3)).max(1)
    too_far = np.ones(piece.max() + 1)
    np.maximum.at(too_far, piece, largest)
    return move / too_far[piece, None]


def _rigid(graph: Graph, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Edges as they were at rest, turned with their first node: blocks and right side."""
    a, b = graph.edges.T
    edge = graph.nodes[b] - graph.nodes[a]
    turned = np.einsum("eij,ej->ei", pose.rotations[a], edge)
    residual = turned + graph.nodes[a] + pose.shifts[a] - graph.nodes[b] - pose.shifts[b]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    stretch = np.linalg.norm(edge + pose.shifts[b] - pose.shifts[a], axis=1, keepdims=True) / length - 1
    root = np.sqrt(RIGID / (1 + (stretch / TEARS) ** 2)) / length
    by_node = np.zeros((len(graph.edges), 2, 3, 6))
    by_node[:, 0, :, :3] = -skew(turned)
    by_node[:, 0, :, 3:], by_node[:, 1, :, 3:] = np.eye(3), -np.eye(3)
    return edge_terms(graph.blocks, graph.edges, by_node * root[:, None, None], residual * root)


def _away(pose: Pose, expected: Pose) -> Float[np.ndarray, " six_n"]:
    """Turns and shifts of nodes from where they were expected."""
    turn = Rotation.from_matrix(pose.rotations @ expected.rotations.transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([turn, pose.shifts - expected.shifts], axis=1).ravel()
