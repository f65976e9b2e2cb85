"""Guides met exactly: linear conditions on the coefficients of every map, and the directions that keep them."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.correspondence.guides import Guides

_INDEPENDENT = 1e-8


class Interpolation:
    """The conditions ``D_i(u_k) = u_ik`` for all guides of all moving shapes.

    ``D_i(u_k)`` is linear in the coefficients of shape i, so the maps that meet the guides form a plane. Projected on its
    directions, gradients and preconditioners are those of the problem with the conditions eliminated, and a step never
    leaves the plane.

    Parameters
    ----------
    guides : Guides
    free : (*n_b, d_par) bool
        Which coefficients are unknowns.
    moving : (n_M,) int
        Shapes that move.

    Notes
    -----
    Conditions that the unknowns cannot change (a guide on a fixed edge) or that repeat each other are met in the sense of least
    squares; :meth:`Guides.residual` tells what is left.
    """

    def __init__(self, guides: Guides, free: Bools, moving: Ints) -> None:
        self._guides = guides
        self._free = free
        self._moving = moving
        # shapes that have the same guides share their conditions
        patterns, which = np.unique(guides.present[moving], axis=0, return_inverse=True)
        n_d = free.shape[-1]
        all_rows = np.kron(guides.rows, np.eye(n_d))[:, free.ravel()]
        self._groups: list[tuple[Ints, Bools, Floats, Floats]] = []
        for k, pattern in enumerate(patterns):
            conditions = np.repeat(pattern, n_d)
            left, values, right = np.linalg.svd(all_rows[conditions], full_matrices=False)
            kept = values > _INDEPENDENT * values.max(initial=0.0)
            basis = right[kept]
            inverse = basis.T @ (left[:, kept] / values[kept]).T
            self._groups.append((np.flatnonzero(which.ravel() == k), conditions, basis, inverse))

    def meet(self, coefficients: Floats) -> Floats:
        """Return the nearest (n_S, *n_b, d_par) coefficients that meet the guides; they may fold."""
        out = coefficients.copy()
        residual = self._guides.residual(coefficients)[self._moving].reshape(len(self._moving), -1)
        moved = out[self._moving]
        for shapes, conditions, _, inverse in self._groups:
            change = np.zeros((len(shapes), *self._free.shape))
            change[:, self._free] = residual[np.ix_(shapes, conditions)] @ inverse.T
            moved[shapes] -= change
        out[self._moving] = moved
        return out

    def along(self, rows: Floats) -> Floats:
        """Return the part of the (n_M, n_free) ``rows`` that leaves all conditions as they are."""
        out = rows.copy()
        for shapes, _, basis, _ in self._groups:
            out[shapes] -= (rows[shapes] @ basis.T) @ basis
        return out
