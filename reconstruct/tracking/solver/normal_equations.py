# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""The matrix of a Gauss-Newton step of the graph, put together block by block: of two nodes that points follow or that
an edge joins. Which there are is known beforehand, so each block is one sum, always in the same order.
"""

from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from scipy.sparse import csc_matrix, csr_matrix

from devrf.reconstruct.kernels.launch import array, launch, use_warp

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Blocks:
    """Pairs of nodes whose moves matter to each other.

    Attributes:
        pair: Nodes, the lower one first [m, 2].
        first: Where the points of each pair begin, and the end of the last one's [m + 1].
        point: Points that follow both, pair by pair [i].
        slot: Which of the point's nodes these two are [i, 2].
        of_node: The pair of each node with itself [n].
        of_edge: The pair of each edge [e].
    """

    pair: Int[np.ndarray, "m 2"]
    first: Int[np.ndarray, " m_and_one"]
    point: Int[np.ndarray, " i"]
    slot: Int[np.ndarray, "i 2"]
    of_node: Int[np.ndarray, " n"]
    of_edge: Int[np.ndarray, " e"]
    _template: csc_matrix

    @staticmethod
    def of(followed: Int[np.ndarray, "p k"], edges: Int[np.ndarray, "e 2"], nodes: int) -> "Blocks":
        """Of the nodes that points follow, and of edges."""
        points, k = followed.shape
        i, j = np.triu_indices(k)
        two = np.stack([followed[:, i], followed[:, j]], -1)  # [p, c, 2]
        slots = np.broadcast_to(np.stack([i, j], -1), two.shape)
        slots = np.where((two[..., 0] > two[..., 1])[..., None], slots[..., ::-1], slots).reshape(-1, 2)
        key = (two.min(-1) * nodes + two.max(-1)).ravel()
        alone = np.arange(nodes) * (nodes + 1)
        low, high = edges.min(1), edges.max(1)
        every, index = np.unique(np.concatenate([key, low * nodes + high, alone]), return_inverse=True)
        of_points, of_edges, of_nodes = np.split(index, [len(key), len(key) + len(edges)])
        order = np.argsort(of_points, kind="stable")
        first = np.searchsorted(of_points[order], np.arange(len(every) + 1))
        pair = np.stack([every // nodes, every % nodes], -1)
        point = np.repeat(np.arange(points), len(i))[order]
        return Blocks(pair, first, point, slots[order], of_nodes, of_edges, _template(pair, nodes))

    def matrix(self, blocks: Float[np.ndarray, "m 6 6"]) -> csc_matrix:
        """The symmetric matrix [6 n, 6 n] of the blocks above its diagonal."""
        template = self._template
        values = np.take(blocks.ravel(), template.data - 1)
        return csc_matrix((values, template.indices, template.indptr), shape=template.shape)


def _template(pair: Int[np.ndarray, "m 2"], nodes: int) -> csc_matrix:
    """Where each number of all blocks goes, counted from 1."""
    rows = 6 * pair[:, :1, None] + np.arange(6)[:, None]
    columns = 6 * pair[:, 1:, None] + np.arange(6)
    rows, columns = (np.broadcast_to(x, (len(pair), 6, 6)) for x in (rows, columns))
    number = np.arange(1, 36 * len(pair) + 1).reshape(rows.shape)
    both = pair[:, 0] != pair[:, 1]
    at = [np.concatenate([x.ravel(), y[both].ravel()]) for x, y in ((rows, columns), (columns, rows))]
    values = np.concatenate([number.ravel(), number[both].ravel()])
    return csc_matrix((values, tuple(at)), shape=(6 * nodes, 6 * nodes))


def skew(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Matrices of the cross product with vectors."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


class Pulls(NamedTuple):
    """What pictures want of all points: the quadratic x^T H x / 2 + b^T x of their moves; 0 where nothing is wanted."""

    hessian: Float[np.ndarray, "p 3 3"]
    gradient: Float[np.ndarray, "p 3"]


def point_terms(
    blocks: Blocks,
    rotations: Float[np.ndarray, "n 3 3"],
    followed: Int[np.ndarray, "p k"],
    offsets: Float[np.ndarray, "p k 3"],
    weights: Float[np.ndarray, "p k"],
    pulls: Pulls,
) -> tuple[Float[np.ndarray, "m 6 6"], Float[np.ndarray, " six_n"]]:
    """What points' quadratics are for small rotations and shifts of the nodes that they follow: blocks and right side.

    Args:
        blocks: Of these points.
        rotations: Of the nodes.
        followed, offsets, weights: Of each point its nodes, its place beside them at rest, and how it follows them.
        pulls: On the points.
    """
    turned = np.einsum("pkij,pkj->pki", rotations[followed], offsets)
    pulled = pulls.gradient[:, None] * weights[..., None]
    wrench = np.concatenate([np.cross(turned, pulled), pulled], -1).reshape(-1, 6)
    nodes = followed.ravel()
    right = np.stack([np.bincount(nodes, column, len(rotations)) for column in wrench.T], -1).ravel()
    out = np.empty((len(blocks.pair), 6, 6))
    if use_warp(CPU):
        shared = (turned, weights, pulls.hessian, blocks.first, blocks.point, blocks.slot)
        kinds = (wp.vec3d, wp.float64, wp.mat33d, wp.int64, wp.int64, wp.vec2l)
        tensors = (torch.from_numpy(np.ascontiguousarray(x)) for x in shared)
        arguments = [array(x, kind) for x, kind in zip(tensors, kinds, strict=True)]
        launch(_summed, len(out), [*arguments, array(torch.from_numpy(out))], CPU)
        return out, right
    lever = np.concatenate([skew(turned), np.broadcast_to(np.eye(3), (*turned.shape, 3))], -2)
    lever = lever * weights[..., None, None]  # [p, k, 6, 3]
    i, j = (lever[blocks.point, slot] for slot in blocks.slot.T)
    each = i @ pulls.hessian[blocks.point] @ j.mT
    for n, (begin, end) in enumerate(zip(blocks.first[:-1], blocks.first[1:], strict=True)):
        out[n] = each[begin:end].sum(0)
    return out, right


def edge_terms(
    blocks: Blocks,
    edges: Int[np.ndarray, "e 2"],
    by_node: Float[np.ndarray, "e 2 3 6"],
    residual: Float[np.ndarray, "e 3"],
) -> tuple[Float[np.ndarray, "m 6 6"], Float[np.ndarray, " six_n"]]:
    """The same of residuals of edges: blocks and right side.

    Args:
        blocks: Of all edges.
        edges: All of them.
        by_node: Derivatives of residuals by small rotations and shifts of both nodes.
        residual: What is to become small.
    """
    first, second = edges.T
    one, other = by_node[:, 0], by_node[:, 1]
    between = one.mT @ other
    between = np.where((first > second)[:, None, None], between.mT, between)
    values = np.concatenate([one.mT @ one, between, other.mT @ other]).reshape(-1, 36)
    rows = np.concatenate([blocks.of_node[first], blocks.of_edge, blocks.of_node[second]])
    summed = csr_matrix(
        (np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(len(blocks.pair), len(rows))
    )
    of_nodes = np.concatenate([(x.mT @ residual[..., None])[..., 0] for x in (one, other)])
    nodes, number = np.concatenate([first, second]), len(blocks.of_node)
    right = np.stack([np.bincount(nodes, column, number) for column in of_nodes.T], -1).ravel().astype(float)
    return (summed @ values).reshape(-1, 6, 6), right


@wp.kernel(enable_backward=False)
@no_type_check
def _summed(
    first_pair: int,
    turned: wp.array2d(dtype=wp.vec3d),
    weights: wp.array2d(dtype=wp.float64),
    hessian: wp.array(dtype=wp.mat33d),
    first: wp.array(dtype=wp.int64),
    point: wp.array(dtype=wp.int64),
    slot: wp.array(dtype=wp.vec2l),
    out: wp.array3d(dtype=wp.float64),
):
    m = first_pair + wp.tid()
    turns = wp.mat33d()
    mixed = wp.mat33d()
    other = wp.mat33d()
    shifts = wp.mat33d()
    for s in range(int(first[m]), int(first[m + 1])):
        p = int(point[s])
        a = int(slot[s][0])
        b = int(slot[s][1])
        H = hessian[p] * (weights[p, a] * weights[p, b])
        left = wp.skew(turned[p, a])
        right = wp.skew(turned[p, b])
        turns -= left * H * right
        mixed += left * H
        other -= H * right
        shifts += H
    for i in range(3):
        for j in range(3):
            out[m, i, j] = turns[i, j]
            out[m, i, 3 + j] = mixed[i, j]
            out[m, 3 + i, j] = other[i, j]
            out[m, 3 + i, 3 + j] = shifts[i, j]
