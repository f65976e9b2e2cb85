"""Unit normals as further components of a spline: the description length then weighs how shapes turn, not only where they lie.

Sliding along a shape costs variance of position whether it is right or wrong. Edges, grooves and flanks tell where it is right, and
there the normals of points that do not belong together differ (Thodberg and Olafsdottir 2003 do it with curvature, Oguz et al. 2008
with local features in an entropy of particles). Curves have unit tangents in their place, which say the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.measure import grid_tangents
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix, gauss_rule, periodic_design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Spline, SplineStack
from ssmpipe.core.spline.knots import breakpoints
from ssmpipe.core.spline.periodic import clamped_control
from ssmpipe.core.spline.surface import BSplineSurface

DEFAULT_NORMALS = 0.7
"""What a unit of the normals weighs [equivalent radii]; see docs/normals.md."""
_NODES_PER_SPAN = 2
_DEGENERATE = 1e-9


class NormalFields:
    """Normal fields of splines that share degree and knots, as splines of the same kind, by least squares at Gauss points.

    Parameters
    ----------
    like : BSplineCurve or BSplineSurface
        One of the splines; surfaces in three dimensions.
    periodic : tuple of bool
        Directions that close: fields close there, too.

    Raises
    ------
    GeometryError
        For surfaces that are not in three dimensions.

    Examples
    --------
    >>> flat = BSplineSurface((1, 1), np.array([0, 0, 1, 1.]), np.array([0, 0, 1, 1.]),
    ...                       np.array([[[0, 0, 0], [0, 2, 0]], [[2, 0, 0], [2, 2, 0.]]]))
    >>> fields = NormalFields(flat, (False, False))
    >>> np.round(fields.beside(flat, 3.0).control_points[0, 0], 6) + 0.0
    array([0., 0., 0., 0., 0., 3.])
    >>> round(fields.radius([flat]) ** 2 * 4 * np.pi, 6)
    4.0
    """

    def __init__(self, like: Spline, periodic: tuple[bool, ...]) -> None:
        if len(like.degrees) == 2 and like.dimension != 3:
            raise GeometryError(f"surfaces in {like.dimension} dimensions have no normals", "set normals to 0")
        self._periodic = periodic
        nodes, weights, self._fit = [], [], []
        for knots, degree, closes in zip(like.knot_vectors, like.degrees, periodic, strict=True):
            ends = breakpoints(knots)
            u, w = gauss_rule(ends, _NODES_PER_SPAN)
            nodes.append(u)
            weights.append(w)
            n_spans = len(ends) - 1
            if closes and np.allclose(np.diff(ends), 1.0 / n_spans) and len(knots) == n_spans + 2 * degree + 1:
                closed = np.linalg.pinv(periodic_design_matrix(u, n_spans, degree))
                self._fit.append(clamped_control(np.eye(n_spans), degree) @ closed)
            else:
                self._fit.append(np.linalg.pinv(design_matrix(u, knots, degree)))
        self._grid = tuple(len(u) for u in nodes)
        self._at = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(1, -1, len(nodes))
        self._weights = weights[0] if len(weights) == 1 else np.multiply.outer(*weights).ravel()

    def radius(self, splines: Sequence[Spline]) -> float:
        """Return their :func:`equivalent_radius`."""
        sizes = [float(self._weights @ np.linalg.norm(self._raw(s), axis=1)) for s in splines]
        return equivalent_radius(sizes, len(self._grid))

    def beside(self, spline: Spline, scale: float) -> Spline:
        """Return the spline of positions and, times ``scale``, unit normals (curves: tangents): twice the components."""
        raw = self._raw(spline)
        field = unit(raw).reshape(*self._grid, -1)
        control = np.tensordot(self._fit[0], field, axes=(1, 0))
        if len(self._grid) == 2:
            control = np.swapaxes(np.tensordot(self._fit[1], control, axes=(1, 1)), 0, 1)
        both = np.concatenate([spline.control_points, scale * control], axis=-1)
        if isinstance(spline, BSplineCurve):
            return BSplineCurve(spline.degree, spline.knots, both)
        return BSplineSurface(spline.degree, spline.knots_u, spline.knots_v, both)

    def _raw(self, spline: Spline) -> Floats:
        """Return ``S_u x S_v`` or ``S_u`` at the nodes, (n, d)."""
        first = SplineStack([spline], self._periodic).evaluate(self._at).first
        return first[0][0] if len(first) == 1 else np.cross(first[0][0], first[1][0])


def equivalent_radius(sizes: Sequence[float], n_directions: int) -> float:
    """Return the radius of the sphere with the mean area of surfaces, or of the circle with the mean length of curves.

    Examples
    --------
    >>> round(equivalent_radius([4 * np.pi, 12 * np.pi], 2) ** 2, 6), round(equivalent_radius([2 * np.pi], 1), 6)
    (2.0, 1.0)
    """
    mean = float(np.mean(sizes))
    return mean / (2 * np.pi) if n_directions == 1 else float(np.sqrt(mean / (4 * np.pi)))


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


def grid_normals(points: Floats, grid: tuple[int, ...], periodic: tuple[bool, ...]) -> tuple[Floats, float]:
    """Return unit normals (curves: tangents) of (n_P, d) points on an even grid, by central differences, and area or length.

    At a pole, where a whole row is one point, it is the mean normal of the row beside it.

    Examples
    --------
    >>> u, v = np.meshgrid(np.arange(4) / 3, np.arange(4) / 3, indexing="ij")
    >>> normals, area = grid_normals(np.stack([2 * u, v, 0 * u], axis=-1).reshape(-1, 3), (4, 4), (False, False))
    >>> normals[0], round(area, 6)
    (array([0., 0., 1.]), 2.0)
    """
    tangents = grid_tangents(points, grid, periodic)
    raw = tangents[0] if len(grid) == 1 else np.cross(tangents[0], tangents[1])
    shares = np.linalg.norm(raw, axis=1).reshape(grid)
    for axis, (n, wraps) in enumerate(zip(grid, periodic, strict=True)):
        if not wraps:  # the rule of trapezoids
            ends = np.moveaxis(shares, axis, 0)
            ends[[0, -1]] *= 0.5
            ends *= n / (n - 1)
    size = float(shares.mean())
    if len(grid) == 1:
        return unit(raw), size
    field = unit(raw).reshape(*grid, -1)
    shape = points.reshape(*grid, -1)
    for end, beside in ((0, 1), (-1, -2)):
        if np.linalg.norm(shape[:, end] - shape[:1, end], axis=-1).max() <= _DEGENERATE * np.sqrt(size):
            field[:, end] = unit(field[:, beside].mean(axis=0, keepdims=True))
    return field.reshape(points.shape), size
