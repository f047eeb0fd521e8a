"""The matrix of a step of the graph against the product of all derivatives, written out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import devrf.reconstruct.tracking.solver.normal_equations as module
from devrf.reconstruct.tracking.solver.normal_equations import Blocks, Pulls, edge_terms, point_terms, skew

NODES, POINTS, FOLLOWED = 7, 60, 3


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def followed_by(rng: np.random.Generator) -> np.ndarray:
    """Of each point some nodes, each once; nobody follows the last node."""
    return np.array([rng.choice(NODES - 1, FOLLOWED, replace=False) for _ in range(POINTS)])


@pytest.mark.parametrize("warp", [True, False])
def test_points_pull_their_nodes_as_the_product_of_derivatives_says(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, warp: bool
) -> None:
    monkeypatch.setattr(module, "use_warp", lambda device: warp)
    followed, rotations = followed_by(rng), Rotation.from_rotvec(rng.normal(size=(NODES, 3))).as_matrix()
    offsets, weights = rng.normal(size=(POINTS, FOLLOWED, 3)), rng.random((POINTS, FOLLOWED))
    slopes, gradient = rng.normal(size=(POINTS, 2, 3)), rng.normal(size=(POINTS, 3))
    hessian = slopes.swapaxes(1, 2) @ slopes
    blocks = Blocks.of(followed, np.array([[0, 6], [6, 0]]), NODES)
    found, right = point_terms(blocks, rotations, followed, offsets, weights, Pulls(hessian, gradient))
    A, b = np.zeros((6 * NODES, 6 * NODES)), np.zeros(6 * NODES)
    for p in range(POINTS):
        by_node = np.zeros((3, 6 * NODES))
        for n, offset, weight in zip(followed[p], offsets[p], weights[p], strict=True):
            turned = rotations[n] @ offset
            by_node[:, 6 * n : 6 * n + 6] = weight * np.hstack([-skew(turned), np.eye(3)])
        A += by_node.T @ hessian[p] @ by_node
        b += by_node.T @ gradient[p]
    np.testing.assert_allclose(blocks.matrix(found).toarray(), A, atol=1e-9)
    np.testing.assert_allclose(right, b, atol=1e-9)
    assert not A[-6:].any() and blocks.of_node.shape == (NODES,)


def test_edges_hold_their_nodes_as_the_product_of_derivatives_says(rng: np.random.Generator) -> None:
    """Edges go both ways."""
    one_way = np.array([[0, 1], [1, 2], [4, 3], [5, 6]])
    edges = np.vstack([one_way, one_way[:, ::-1]])
    by_node, residual = rng.normal(size=(len(edges), 2, 3, 6)), rng.normal(size=(len(edges), 3))
    blocks = Blocks.of(followed_by(rng), edges, NODES)
    found, right = edge_terms(blocks, edges, by_node, residual)
    J = np.zeros((3 * len(edges), 6 * NODES))
    for n, (edge, both) in enumerate(zip(edges, by_node, strict=True)):
        for node, of_node in zip(edge, both, strict=True):
            J[3 * n : 3 * n + 3, 6 * node : 6 * node + 6] = of_node
    np.testing.assert_allclose(blocks.matrix(found).toarray(), J.T @ J, atol=1e-9)
    np.testing.assert_allclose(right, J.T @ residual.ravel(), atol=1e-9)
    alone = np.zeros((0, 2), dtype=int)  # a graph of nodes that nothing joins
    nothing, zero = edge_terms(Blocks.of(followed_by(rng), alone, NODES), alone, by_node[:0], residual[:0])
    assert not nothing.any() and not zero.any()
