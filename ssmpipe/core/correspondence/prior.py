"""Smoothness prior on a reparameterization: the thin-plate energy of its displacement."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.basis import design_matrix, gauss_rule


def thin_plate_matrix(reparameterization: Reparameterization) -> Floats:
    """Return the matrix ``K`` of ``integral D_uu^2 + 2 D_uv^2 + D_vv^2`` for one component of ``D``.

    Exact for B-splines by Gauss quadrature. The identity has no energy, so the energy of ``D`` is that of ``D - id``.

    Returns
    -------
    (n_b1 * n_b2, n_b1 * n_b2) float64
        Symmetric, positive semidefinite; its kernel are the affine maps.

    Examples
    --------
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> bool(np.allclose(thin_plate_matrix(D) @ D.identity()[..., 0].ravel(), 0, atol=1e-10))
    True
    """
    grams = []
    for knots in reparameterization.knots:
        nodes, weights = gauss_rule(knots, reparameterization.degree + 1)
        bases = [design_matrix(nodes, knots, reparameterization.degree, r) for r in range(3)]
        grams.append([b.T @ (weights[:, None] * b) for b in bases])
    (u0, u1, u2), (v0, v1, v2) = grams
    return np.kron(u2, v0) + 2.0 * np.kron(u1, v1) + np.kron(u0, v2)
