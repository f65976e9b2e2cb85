"""Smoothness prior on a reparameterization: the bending energy of its displacement."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.reparameterization import Reparameterization


def bending_matrix(reparameterization: Reparameterization) -> Floats:
    """Return the matrix ``K`` of ``integral D''^2``, or ``D_uu^2 + 2 D_uv^2 + D_vv^2``, for one component of ``D - id``.

    Exact for B-splines by Gauss quadrature. The identity has no energy.

    Returns
    -------
    (n, n) float64
        ``n = prod(n_coefficients)``. Symmetric, positive semidefinite; its kernel are the affine maps (the constant in a
        periodic direction).

    Examples
    --------
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> bool(np.allclose(bending_matrix(D) @ D.identity()[..., 0].ravel(), 0, atol=1e-10))
    True
    """
    grams = []
    for direction in reparameterization.directions:
        nodes, weights = direction.gauss_rule(reparameterization.degree + 1)
        bases = [direction.matrix(nodes, r) for r in range(3)]
        grams.append([b.T @ (weights[:, None] * b) for b in bases])
    if len(grams) == 1:
        return np.asarray(grams[0][2])
    (u0, u1, u2), (v0, v1, v2) = grams
    return np.asarray(np.kron(u2, v0) + 2.0 * np.kron(u1, v1) + np.kron(u0, v2))
