"""Place the inner vertices so that each is the weighted average of its neighbours."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ssmpipe.core.arrays import Floats, Ints


def solve_averages(weights: sparse.csr_matrix, fixed: Ints, fixed_values: Floats) -> Floats:
    """Solve ``x_j = sum_k w_jk x_k / sum_k w_jk`` for all vertices that are not fixed (Li 2015, eq. 4.1-4.4).

    Parameters
    ----------
    weights : (n, n) sparse
        Not necessarily symmetric; rows need not be normalized.
    fixed : (m,) int64
    fixed_values : (m, d) float64

    Returns
    -------
    (n, d) float64

    Examples
    --------
    >>> chain = sparse.csr_matrix(np.eye(3, k=1) + np.eye(3, k=-1))
    >>> solve_averages(chain, np.array([0, 2]), np.array([[0.0], [1.0]])).ravel()
    array([0. , 0.5, 1. ])
    """
    n = weights.shape[0]
    free = np.ones(n, dtype=bool)
    free[fixed] = False
    inner = np.flatnonzero(free)
    values = np.zeros((n, fixed_values.shape[1]))
    values[fixed] = fixed_values
    if len(inner) == 0:
        return values
    rows = weights[inner]
    total = np.asarray(rows.sum(axis=1)).ravel()
    rows = sparse.diags(1.0 / total) @ rows
    matrix = sparse.identity(len(inner), format="csc") - rows[:, inner].tocsc()
    values[inner] = splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
    ).solve(rows[:, fixed] @ fixed_values)
    return values
