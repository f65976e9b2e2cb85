from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from ssmpipe.core.mesh.operators import adjacency
from ssmpipe.core.mesh.primitives import star_shape
from ssmpipe.core.mesh.symmetric import factorized, solve


def test_it_solves_for_one_and_several_right_sides_with_less_fill() -> None:
    near = adjacency(star_shape(4))
    matrix = sparse.diags(np.asarray(near.sum(axis=1)).ravel() + 0.01) - near
    right = np.random.default_rng(0).normal(size=(matrix.shape[0], 3))
    found = solve(matrix, right)
    assert matrix @ found == pytest.approx(right, abs=1e-10)
    assert solve(matrix, right[:, 1]) == pytest.approx(found[:, 1], rel=1e-12)
    ours, plain = factorized(matrix), splu(sparse.csc_matrix(matrix))
    assert ours.L.nnz + ours.U.nnz < 0.75 * (plain.L.nnz + plain.U.nnz)
