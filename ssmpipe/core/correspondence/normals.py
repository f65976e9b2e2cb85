"""Unit normals as further components of a spline: the description length then weighs how shapes turn, not only where they lie.

Sliding along a shape costs variance of position whether it is right or wrong. Edges, grooves and flanks tell where it is right, and
there the normals of points that do not belong together differ (Thodberg and Olafsdottir 2003 do it with curvature, Oguz et al. 2008
with local features in an entropy of particles). Curves have unit tangents in their place, which say the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix, gauss_rule, periodic_design_matrix
from ssmpipe.core.spline.evaluate import Jet, Spline, SplineStack
from ssmpipe.core.spline.knots import breakpoints
from ssmpipe.core.spline.periodic import clamped_control

DEFAULT_NORMALS = 0.8
"""What a unit of the normals weighs [spreads]; see docs/normals.md."""
_DEGENERATE = 1e-9


class NormalFields:
    """Normal fields of splines that share degree and knots, as splines of the same kind, by least squares at Gauss points.

    Parameters
    ----------
    like : BSplineCurve or BSplineSurface
        One of the splines; surfaces in three dimensions.
    periodic : tuple of bool
        Directions that close: fields close there, too, if knots are equally spaced.

    Raises
    ------
    GeometryError
        For surfaces that are not in three dimensions.

    Examples
    --------
    >>> from ssmpipe.core.spline.surface import BSplineSurface
    >>> flat = BSplineSurface((1, 1), np.array([0, 0, 1, 1.]), np.array([0, 0, 1, 1.]),
    ...                       np.array([[[0, 0, 0], [0, 2, 0]], [[2, 0, 0], [2, 2, 0.]]]))
    >>> fields = NormalFields(flat, (False, False))
    >>> np.round(fields.beside(flat, 3.0).control_points[0, 0], 6) + 0.0
    array([0., 0., 0., 0., 0., 3.])
    >>> round(fields.spread([flat]) ** 2, 6)
    0.5
    """

    def __init__(self, like: Spline, periodic: tuple[bool, ...]) -> None:
        if len(like.degrees) == 2 and like.dimension != 3:
            raise GeometryError(f"surfaces in {like.dimension} dimensions have no normals", "set normals to 0")
        self._periodic = periodic
        nodes, weights, self._fit = [], [], []
        for knots, degree, closes in zip(like.knot_vectors, like.degrees, periodic, strict=True):
            ends = breakpoints(knots)
            n_spans = len(ends) - 1
            u, w = gauss_rule(ends, max(2, -(-(n_spans + degree) // n_spans)))
            nodes.append(u)
            weights.append(w)
            if closes and np.allclose(np.diff(ends), 1.0 / n_spans) and len(knots) == n_spans + 2 * degree + 1:
                closed = np.linalg.pinv(periodic_design_matrix(u, n_spans, degree))
                self._fit.append(clamped_control(np.eye(n_spans), degree) @ closed)
            else:
                self._fit.append(np.linalg.pinv(design_matrix(u, knots, degree)))
        self._grid = tuple(len(u) for u in nodes)
        self._at = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(1, -1, len(nodes))
        self._weights = weights[0] if len(weights) == 1 else np.multiply.outer(*weights).ravel()

    def spread(self, splines: Sequence[Spline]) -> float:
        """Return how far the shapes reach across their longest axis, in the root mean square: 1 for the unit sphere or circle [mm]."""
        moments = np.zeros(splines[0].dimension)
        for spline in splines:
            jet = self._jet(spline)
            share = self._weights * np.linalg.norm(_raw(jet), axis=1)
            share /= share.sum()
            points = jet.points[0] - share @ jet.points[0]
            moments += np.linalg.eigvalsh(points.T @ (share[:, None] * points)) / len(splines)
        return float(np.sqrt((1 + len(self._grid)) * moments[:-1].mean()))

    def beside(self, spline: Spline, scale: float) -> Spline:
        """Return the spline of positions and, times ``scale``, unit normals (curves: tangents): twice the components."""
        field = unit(_raw(self._jet(spline))).reshape(*self._grid, -1)
        control = np.tensordot(self._fit[0], field, axes=(1, 0))
        if len(self._grid) == 2:
            control = np.swapaxes(np.tensordot(self._fit[1], control, axes=(1, 1)), 0, 1)
        return spline.with_control(np.concatenate([spline.control_points, scale * control], axis=-1))

    def at(self, splines: Sequence[Spline], parameters: Floats) -> Floats:
        """Return the (n_S, n_P, d) normals of splines, each at its own (n_P, d_par) parameters."""
        stack = SplineStack([self.beside(s, 1.0) for s in splines], self._periodic)
        return stack.evaluate(parameters).points[..., splines[0].dimension :]

    def _jet(self, spline: Spline) -> Jet:
        return SplineStack([spline], self._periodic).evaluate(self._at)


def _raw(jet: Jet) -> Floats:
    """Return ``S_u x S_v`` or ``S_u`` of one spline, (n, d)."""
    return jet.first[0][0] if len(jet.first) == 1 else np.cross(jet.first[0][0], jet.first[1][0])


def carried(normals: Floats, linear: Floats, *, tangents: bool = False) -> Floats:
    """Return (n_S, n_P, d) normals after the linear maps (n_S, d, d) of their shapes, or the tangents of curves; lengths stay.

    Examples
    --------
    >>> stretch = np.array([np.diag([2.0, 1.0])])
    >>> carried(np.array([[[0.6, 0.8]]]), stretch).round(3)
    array([[[0.351, 0.936]]])
    >>> carried(np.array([[[0.8, -0.6]]]), stretch, tangents=True).round(3)
    array([[[ 0.936, -0.351]]])
    """
    moved = normals @ (np.swapaxes(linear, 1, 2) if tangents else np.linalg.inv(linear))
    return np.asarray(moved * (np.linalg.norm(normals, axis=-1) / np.linalg.norm(moved, axis=-1))[..., None])


def unit(vectors: Floats) -> Floats:
    """Return (n, d) vectors of length 1; those without direction stay as short as they are, compared with the longest.

    Examples
    --------
    >>> unit(np.array([[3.0, 4.0], [0.0, 0.0]]))
    array([[0.6, 0.8],
           [0. , 0. ]])
    """
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, _DEGENERATE * max(float(length.max()), np.finfo(float).tiny)))
