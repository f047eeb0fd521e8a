"""Sparse least squares of which most unknowns fall into small independent blocks: the Schur complement.

Unknowns are split into *outer* ones (cameras) and *inner* ones (points, boards), the inner ones into blocks
that no row of the Jacobian mixes. With J = [A B], H = J^T J: eliminating the inner unknowns leaves
S = A^T A - A^T B (B^T B)^-1 B^T A of the size of the cameras (Triggs et al., "Bundle Adjustment - A Modern
Synthesis", 2000, section 6.1). The inverse of S is the covariance of the outer unknowns.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

TINY = 1e-12  # of the largest diagonal entry: an inner unknown that nothing constrains stays where it is


@dataclass(frozen=True)
class Normal:
    """Normal equations J^T J x = -J^T r, split.

    Attributes:
        U: A^T A [outer, outer]; W: A^T B [outer, inner]; V: B^T B as dense blocks, one array [n, d, d] per
            block size.
        columns: Inner columns of the blocks, one array [n, d] per block size.
        a, b: Gradients A^T r, B^T r.
    """

    U: Float[np.ndarray, "outer outer"]
    W: sp.csr_matrix
    V: tuple[Float[np.ndarray, "_ _ _"], ...]
    columns: tuple[Int[np.ndarray, "_ _"], ...]
    a: Float[np.ndarray, " outer"]
    b: Float[np.ndarray, " inner"]


def normal_equations(
    A: sp.csr_matrix,
    B: sp.csr_matrix,
    r: Float[np.ndarray, " rows"],
    columns: tuple[Int[np.ndarray, "_ _"], ...],
) -> Normal:
    """Multiply out; `columns` says which inner columns form a block (one array [n, d] per block size)."""
    product, gradient = sp.coo_matrix(B.T @ B), B.T @ r
    block, place, size = (np.zeros(len(gradient), dtype=np.int64) for _ in range(3))
    for cols in columns:
        block[cols] = np.arange(len(cols))[:, None]
        place[cols] = np.arange(cols.shape[1])
        size[cols] = cols.shape[1]
    V = []
    for cols in columns:
        blocks = np.zeros((*cols.shape, cols.shape[1]))
        own = size[product.row] == cols.shape[1]
        row, col = product.row[own], product.col[own]
        blocks[block[row], place[row], place[col]] = product.data[own]
        V.append(blocks)
    return Normal((A.T @ A).toarray(), sp.csr_matrix(A.T @ B), tuple(V), columns, A.T @ r, gradient)


def step(normal: Normal, damping: float) -> tuple[Float[np.ndarray, " outer"], Float[np.ndarray, " inner"]]:
    """The damped step of the outer and of the inner unknowns (Marquardt's scaled damping)."""
    S, V_inv = complement(normal, damping)
    outer = (
        np.linalg.lstsq(S, normal.W @ (V_inv @ normal.b) - normal.a, rcond=None)[0] if len(S) else np.zeros(0)
    )
    return outer, -(V_inv @ (normal.b + normal.W.T @ outer))


def complement(
    normal: Normal, damping: float = 0.0
) -> tuple[Float[np.ndarray, "outer outer"], sp.csr_matrix]:
    """S, and the inverse of V as a sparse matrix."""
    inner = len(normal.b)
    rows, cols, data = [], [], []
    for blocks, columns in zip(normal.V, normal.columns, strict=True):
        if not len(blocks):
            continue
        d = columns.shape[1]
        diagonal = np.einsum("nii->ni", blocks)
        extra = damping * diagonal + TINY * diagonal.max(initial=1.0)
        rows.append(np.repeat(columns, d, axis=1).reshape(-1))
        cols.append(np.tile(columns, (1, d)).reshape(-1))
        data.append(np.linalg.inv(blocks + extra[:, :, None] * np.eye(d)).reshape(-1))
    if not data:
        return normal.U + damping * np.diag(np.diag(normal.U)), sp.csr_matrix((inner, inner))
    V_inv = sp.csr_matrix(
        (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols))), shape=(inner, inner)
    )
    S = normal.U + damping * np.diag(np.diag(normal.U)) - (normal.W @ V_inv @ normal.W.T).toarray()
    return S, V_inv
