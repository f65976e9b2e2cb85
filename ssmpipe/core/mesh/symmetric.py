"""Linear equations with a symmetric positive definite sparse matrix."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from ssmpipe.core.arrays import Floats


def factorized(matrix: sparse.spmatrix) -> SuperLU:
    """Factorize a symmetric positive definite matrix, such as the stiffness of a surface held somewhere.

    Rows and columns are ordered together by minimum degree of ``A + A'``, and pivots stay on the diagonal: two thirds of the fill of the
    order that SuperLU takes for matrices without symmetry.

    Examples
    --------
    >>> factorized(sparse.diags([2.0, 4.0])).solve(np.array([2.0, 2.0]))
    array([1. , 0.5])
    """
    return splu(
        sparse.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def solve(matrix: sparse.spmatrix, right: Floats) -> Floats:
    """Solve the equations for one right side, (n,), or several, (n, k); see :func:`factorized`."""
    return np.asarray(factorized(matrix).solve(np.ascontiguousarray(right, dtype=np.float64)))
