"""The quadrature rule that integrates the covariance of reparameterized curves exactly: its spans move with the maps."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.direction import Direction
from ssmpipe.core.covariance.quadrature import gauss, gauss_points_for_exact
from ssmpipe.core.spline.knots import breakpoints

_BISECTIONS = 54
_SAME = 1e-12


class ExactRule:
    """Gauss points on the spans over which every ``S_i(D_i(u))`` is one polynomial (Li 2015, [3.31] and table 3.2).

    The covariance of formulation I by this rule is its closed form [3.30], to rounding. So is its gradient at fixed nodes: where
    a span ends the integrand is continuous, so the motion of the ends adds nothing, and what is left is a polynomial of
    the same degree ``2 p d`` on every span.

    Parameters
    ----------
    direction : Direction
        Space of the maps ``D_i``, degree d.
    shape_knots : (m,) float64
        Knots of the curves.
    shape_degree : int
        Degree p of the curves.

    Examples
    --------
    >>> rule = ExactRule(Direction(4, 2), np.array([0, 0, 0, 0.5, 1, 1, 1]), 2)
    >>> nodes, weights = rule(np.array([[[0.0], [0.25], [0.75], [1.0]], [[0.0], [0.15], [0.7], [1.0]]]))
    >>> len(nodes), bool(np.isclose(weights.sum(), 1.0))
    (15, True)
    """

    def __init__(self, direction: Direction, shape_knots: Floats, shape_degree: int) -> None:
        self._direction = direction
        # on a closed curve the seam is a knot like any other, met once
        self._targets = breakpoints(shape_knots)[:-1] if direction.periodic else breakpoints(shape_knots)[1:-1]
        self._n_per_span = gauss_points_for_exact(shape_degree, direction.degree)
        d = direction.degree
        t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(d + 1) + 0.5) / (d + 1))
        ends = direction.breakpoints
        basis = direction.matrix((ends[:-1, None] + np.diff(ends)[:, None] * t).ravel())
        local = np.linalg.inv(np.vander(t, increasing=True)) @ basis.reshape(direction.n_spans, d + 1, -1)
        self._local = np.asarray(local, np.float64)

    def __call__(self, coefficients: Floats) -> tuple[Floats, Floats]:
        """Return nodes and weights, (n_P,) each, for the (n_S, n_b, 1) coefficients of increasing maps."""
        d = self._direction
        inverse = self._inverse(coefficients[..., 0] - d.identity).ravel()
        merged = np.sort(np.concatenate([d.breakpoints, np.clip(inverse, 0.0, 1.0)]))
        ends = merged[np.concatenate([[True], np.diff(merged) > _SAME])]
        ends[-1] = 1.0
        return gauss(ends, self._n_per_span)

    def _inverse(self, displacement: Floats) -> Floats:
        """Return the (n_S, n_knots) parameters that the maps send to knots, by bisection on the span of each."""
        ends, width = self._direction.breakpoints, 1.0 / self._direction.n_spans
        pieces = np.einsum("sab,ib->isa", self._local, displacement)
        begins = ends[:-1] + pieces[..., 0]
        targets = np.broadcast_to(self._targets, (len(displacement), len(self._targets)))
        if self._direction.periodic:
            targets = targets + np.ceil(begins[:, :1] - targets)
        span = np.maximum((begins[:, None, :] <= targets[..., None]).sum(axis=-1) - 1, 0)
        own = np.take_along_axis(pieces, span[..., None], axis=1)
        left = ends[span]
        low, high = np.zeros_like(targets), np.ones_like(targets)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            value = own[..., -1]
            for k in range(own.shape[-1] - 2, -1, -1):
                value = value * middle + own[..., k]
            below = left + width * middle + value < targets
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(left + width * 0.5 * (low + high))
