"""Many spline surfaces evaluated at their own scattered points: position and both derivatives in one pass.

The surfaces are converted once to local polynomials, one coefficient block per knot-span rectangle, so that a point
costs one gather of ``(p+1)(q+1)d`` numbers and a Horner scheme that yields ``S``, ``S_u`` and ``S_v`` together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.knots import breakpoints
from ssmpipe.core.spline.surface import BSplineSurface


def _span_polynomials(knots: Floats, degree: int) -> Floats:
    """Return (n_spans, degree + 1, n_control): monomial coefficients, in the local t in [0, 1], of every basis function."""
    ends = breakpoints(knots)
    # the outermost nodes stay inside the span, so that each belongs to it without doubt
    t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    nodes = ends[:-1, None] + np.diff(ends)[:, None] * t
    values = design_matrix(nodes.ravel(), knots, degree).reshape(len(ends) - 1, degree + 1, -1)
    vandermonde = np.vander(t, increasing=True)
    return np.asarray(
        np.linalg.solve(np.broadcast_to(vandermonde, (len(ends) - 1, degree + 1, degree + 1)), values), float
    )


class SurfaceStack:
    """Surfaces that share degree and knots, ready for repeated evaluation.

    Parameters
    ----------
    surfaces : sequence of BSplineSurface
        ``n_S`` surfaces of equal degree, knots and dimension d.

    Raises
    ------
    GeometryError
        If the surfaces differ in degree, knots or dimension.

    Examples
    --------
    >>> flat = BSplineSurface((1, 1), np.array([0, 0, 1, 1.]), np.array([0, 0, 1, 1.]),
    ...                       np.array([[[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0.]]]))
    >>> SurfaceStack([flat]).evaluate(np.array([[[0.25, 0.5]]]))[0]
    array([[[0.25, 0.5 , 0.  ]]])
    """

    def __init__(self, surfaces: Sequence[BSplineSurface]) -> None:
        first = surfaces[0]
        for k, other in enumerate(surfaces):
            if other.degree != first.degree or other.dimension != first.dimension:
                raise GeometryError(
                    f"surface {k} has degree {other.degree} and dimension {other.dimension}, "
                    f"surface 0 has {first.degree} and {first.dimension}",
                    "fit all shapes with the same degree",
                )
            if not (np.array_equal(other.knots_u, first.knots_u) and np.array_equal(other.knots_v, first.knots_v)):
                raise GeometryError(
                    f"surface {k} has other knots than surface 0", "fit all shapes with the same control points"
                )
        self.n_shapes = len(surfaces)
        self.dimension = first.dimension
        self.degree = first.degree
        self._ends = (breakpoints(first.knots_u), breakpoints(first.knots_v))
        self._uniform = tuple(bool(np.allclose(np.diff(e), e[1] - e[0], rtol=1e-12, atol=0)) for e in self._ends)
        poly_u = _span_polynomials(first.knots_u, first.degree[0])
        poly_v = _span_polynomials(first.knots_v, first.degree[1])
        p, q, d = first.degree[0], first.degree[1], first.dimension
        blocks = []
        for surface in surfaces:
            inner = np.einsum("sak,kld->sald", poly_u, surface.control_points, optimize=True)
            local = np.einsum("tbl,sald->stabd", poly_v, inner, optimize=True)
            blocks.append(np.ascontiguousarray(local.reshape(len(poly_u) * len(poly_v), (p + 1) * (q + 1) * d)))
        self._blocks = blocks

    def _locate(self, axis: int, parameters: Floats) -> tuple[np.ndarray, Floats, float | Floats]:
        """Return span index, local coordinate t in [0, 1] and 1 / span length."""
        ends = self._ends[axis]
        n_spans = len(ends) - 1
        if self._uniform[axis]:
            scaled = parameters * n_spans
            index = np.clip(scaled.astype(np.int64), 0, n_spans - 1)
            return index, scaled - index, float(n_spans)
        index = np.clip(np.searchsorted(ends, parameters, side="right") - 1, 0, n_spans - 1)
        inverse = 1.0 / np.diff(ends)[index]
        return index, (parameters - ends[index]) * inverse, inverse

    def evaluate(self, parameters: Floats) -> tuple[Floats, Floats, Floats]:
        """Return positions and first derivatives of all surfaces, each at its own points.

        Parameters
        ----------
        parameters : (n_S, n_P, 2) float64
            In the unit square.

        Returns
        -------
        points, derivative_u, derivative_v : (n_S, n_P, d) float64
        """
        n_points = parameters.shape[1]
        shape = (self.n_shapes, n_points, self.dimension)
        out = np.empty(shape), np.empty(shape), np.empty(shape)
        for i in range(self.n_shapes):
            self.evaluate_one(i, parameters[i], out[0][i], out[1][i], out[2][i])
        return out

    def evaluate_one(
        self, i: int, parameters: Floats, points: Floats, derivative_u: Floats, derivative_v: Floats
    ) -> None:
        """Evaluate surface ``i`` at (n, 2) ``parameters`` into the given (n, d) arrays."""
        p, q = self.degree
        index_u, t, du = self._locate(0, parameters[:, 0])
        index_v, s, dv = self._locate(1, parameters[:, 1])
        block = self._blocks[i][index_u * (len(self._ends[1]) - 1) + index_v].reshape(
            -1, p + 1, (q + 1) * self.dimension
        )
        t = t[:, None]
        row = block[:, p].copy()
        row_t = np.zeros_like(row)
        for k in range(p - 1, -1, -1):
            row_t *= t
            row_t += row
            row *= t
            row += block[:, k]
        row = row.reshape(-1, q + 1, self.dimension)
        row_t = row_t.reshape(-1, q + 1, self.dimension)
        s = s[:, None]
        value = row[:, q].copy()
        value_t = row_t[:, q].copy()
        value_s = np.zeros_like(value)
        for k in range(q - 1, -1, -1):
            value_s *= s
            value_s += value
            value *= s
            value += row[:, k]
            value_t *= s
            value_t += row_t[:, k]
        points[...] = value
        derivative_u[...] = value_t * (du if np.ndim(du) == 0 else np.asarray(du)[:, None])
        derivative_v[...] = value_s * (dv if np.ndim(dv) == 0 else np.asarray(dv)[:, None])
