"""Exact composition ``S(D(u))`` of spline curves with spline reparameterizations, in Bernstein form."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import FoldoverError, GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import breakpoints, find_spans


def bernstein_product(a: Floats, b: Floats) -> Floats:
    """Return the Bernstein coefficients of the product of two polynomials on the unit interval.

    Parameters
    ----------
    a : (..., p + 1) float64
    b : (..., q + 1) float64
        Leading axes broadcast.

    Returns
    -------
    (..., p + q + 1) float64
        Farouki and Rajan (1988), eq. 44; Li (2015), [C.5].

    Examples
    --------
    >>> bernstein_product(np.array([0.0, 1.0]), np.array([0.0, 1.0]))  # u * u
    array([0., 0., 1.])
    """
    p, q = a.shape[-1] - 1, b.shape[-1] - 1
    scaled_a, scaled_b = a * _binomials(p), b * _binomials(q)
    out = np.zeros((*np.broadcast_shapes(a.shape[:-1], b.shape[:-1]), p + q + 1))
    for i in range(p + 1):
        out[..., i : i + q + 1] += scaled_a[..., i : i + 1] * scaled_b
    return out / _binomials(p + q)


def bernstein_compose(outer: Floats, inner: Floats) -> Floats:
    """Return the Bernstein coefficients of ``outer(inner(t))``.

    De Casteljau's scheme with polynomials in place of numbers (DeRose 1988): for ``inner`` within [0, 1] every step is a
    convex combination, so nothing cancels.

    Parameters
    ----------
    outer : (..., p + 1, d) float64
    inner : (..., q + 1) float64

    Returns
    -------
    (..., p q + 1, d) float64

    Examples
    --------
    >>> bernstein_compose(np.array([[0.0], [0.0], [1.0]]), np.array([0.0, 0.0, 1.0])).ravel()  # (t^2)^2
    array([0., 0., 0., 0., 1.])
    """
    weight = inner[..., None, :]
    rest = 1.0 - weight
    points = [outer[..., i, :, None] for i in range(outer.shape[-2])]
    while len(points) > 1:
        points = [bernstein_product(rest, a) + bernstein_product(weight, b) for a, b in pairwise(points)]
    return np.ascontiguousarray(np.swapaxes(points[0], -1, -2))


def bezier_pieces(knots: Floats, degree: int, coefficients: Floats, ends: Floats) -> Floats:
    """Return the Bernstein coefficients of a spline on the given intervals, by its blossom (Ramshaw 1989).

    Parameters
    ----------
    knots : (n + degree + 1,) float64
    degree : int
    coefficients : (n, d) float64
    ends : (m + 1,) float64
        Increasing, with every distinct knot among them.

    Returns
    -------
    (m, degree + 1, d) float64

    Examples
    --------
    >>> bezier_pieces(np.array([0, 0, 0, 1, 1, 1.0]), 2, np.array([[0.0], [0.0], [1.0]]), np.array([0, 0.5, 1]))[..., 0]
    array([[0.  , 0.  , 0.25],
           [0.25, 0.5 , 1.  ]])
    """
    left, right = ends[:-1], ends[1:]
    span = find_spans(knots, degree, 0.5 * (left + right))
    local = coefficients[span[:, None] - degree + np.arange(degree + 1)]
    out = np.empty_like(local)
    for j in range(degree + 1):
        values = local
        for level in range(1, degree + 1):
            argument = left if level <= degree - j else right
            index = span[:, None] + np.arange(degree + 1 - level)
            low, high = knots[index - degree + level], knots[index + 1]
            alpha = ((argument[:, None] - low) / (high - low))[..., None]
            values = (1.0 - alpha) * values[:, :-1] + alpha * values[:, 1:]
        out[:, j] = values[:, 0]
    return out


def inverse_parameters(mapping: BSplineCurve, values: Floats) -> Floats:
    """Return the parameters ``psi`` with ``D(psi) = values`` (Li 2015, [3.31]).

    Parameters
    ----------
    mapping : BSplineCurve
        Of dimension 1, increasing from 0 to 1.
    values : (n,) float64
        In [0, 1].

    Returns
    -------
    (n,) float64
        To the last bit that ``D`` resolves, by bisection.

    Raises
    ------
    FoldoverError
        If ``D`` is not increasing.
    GeometryError
        If it is no map of the unit interval onto itself.

    Examples
    --------
    >>> square = BSplineCurve(2, np.array([0, 0, 0, 1, 1, 1.0]), np.array([[0.0], [0.2], [1.0]]))  # 0.4 u + 0.6 u^2
    >>> inverse_parameters(square, np.array([0.0, 0.35, 1.0]))
    array([0. , 0.5, 1. ])
    """
    check_reparameterization(mapping)
    evaluate = BSpline(mapping.knots, mapping.control_points[:, 0], mapping.degree)
    low, high = np.zeros_like(values), np.ones_like(values)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = evaluate(middle) < values
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    middle = 0.5 * (low + high)
    return np.asarray(np.where(values <= 0.0, 0.0, np.where(values >= 1.0, 1.0, middle)))


def check_reparameterization(mapping: BSplineCurve) -> None:
    """Check that a spline maps the unit interval onto itself without folding.

    The Bernstein coefficients on every knot span must increase: sufficient, and necessary up to degree 2 (Li 2015, [3.18]).

    Raises
    ------
    FoldoverError
        With the parameter of the first fold.
    GeometryError
        If the dimension is not 1 or the ends are not 0 and 1.
    """
    if mapping.dimension != 1:
        raise GeometryError(f"a reparameterization of curves has dimension 1, got {mapping.dimension}")
    first, last = mapping.control_points[[0, -1], 0]
    if abs(first) > 1e-12 or abs(last - 1.0) > 1e-12:
        raise GeometryError(f"the reparameterization maps [0, 1] to [{first:.6g}, {last:.6g}], need [0, 1]")
    ends = breakpoints(mapping.knots)
    pieces = bezier_pieces(mapping.knots, mapping.degree, mapping.control_points, ends)[..., 0]
    steps = np.diff(pieces, axis=1)
    folded = np.flatnonzero(np.any(steps < 0, axis=1) | np.all(steps <= 0, axis=1))
    if len(folded):
        k = int(folded[0])
        raise FoldoverError(
            f"the reparameterization decreases between {ends[k]:.4g} and {ends[k + 1]:.4g} (by {-steps[k].min():.3g})",
            "keep its coefficients increasing",
        )


def refined_breakpoints(shape_knots: Floats, maps: Sequence[BSplineCurve], tolerance: float = 1e-12) -> Floats:
    """Return the ends of the spans over which every ``S_i(D_i(u))`` is one polynomial.

    Parameters
    ----------
    shape_knots : (m,) float64
        Knots of the curves.
    maps : sequence of BSplineCurve
        One reparameterization per curve; dimension 1.
    tolerance : float, default=1e-12
        Ends closer than this become one.

    Returns
    -------
    (n_spans + 1,) float64
        The knots of all ``D_i`` and the parameters that a ``D_i`` sends to a knot of the curves.

    Raises
    ------
    FoldoverError
        If a ``D_i`` is not increasing.
    """
    targets = breakpoints(shape_knots)
    ends = [breakpoints(m.knots) for m in maps] + [inverse_parameters(m, targets) for m in maps]
    merged = np.unique(np.concatenate(ends))
    keep = np.concatenate([[True], np.diff(merged) > tolerance])
    merged = merged[keep]
    merged[-1] = 1.0
    return merged


def composed_pieces(curve: BSplineCurve, mapping: BSplineCurve, ends: Floats) -> Floats:
    """Return the Bernstein coefficients of ``S(D(u))`` on the given spans (Li 2015, [3.26, 3.27]).

    Parameters
    ----------
    curve : BSplineCurve
        ``S``, degree p.
    mapping : BSplineCurve
        ``D``, degree q, dimension 1.
    ends : (m + 1,) float64
        At least :func:`refined_breakpoints` of the two.

    Returns
    -------
    (m, p q + 1, d) float64
    """
    inner = bezier_pieces(mapping.knots, mapping.degree, mapping.control_points, ends)[..., 0]
    shape_ends = breakpoints(curve.knots)
    middle = BSpline(mapping.knots, mapping.control_points[:, 0], mapping.degree)(0.5 * (ends[:-1] + ends[1:]))
    piece = np.clip(np.searchsorted(shape_ends, middle, side="right") - 1, 0, len(shape_ends) - 2)
    outer = bezier_pieces(curve.knots, curve.degree, curve.control_points, shape_ends)[piece]
    local = (inner - shape_ends[piece][:, None]) / np.diff(shape_ends)[piece][:, None]
    return bernstein_compose(outer, local)


def compose_curve(curve: BSplineCurve, mapping: BSplineCurve) -> BSplineCurve:
    """Return ``S(D(u))`` as one B-spline curve of degree ``p q`` on the refined knots, exact up to rounding.

    Interior knots have multiplicity ``p q``: the pieces stay readable as Bezier curves.

    Raises
    ------
    FoldoverError
        If ``D`` is not increasing.

    Examples
    --------
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0.0, 0.0], [2.0, 4.0]]))
    >>> square = BSplineCurve(2, np.array([0, 0, 0, 1, 1, 1.0]), np.array([[0.0], [0.2], [1.0]]))
    >>> compose_curve(line, square).control_points
    array([[0. , 0. ],
           [0.4, 0.8],
           [2. , 4. ]])
    """
    ends = refined_breakpoints(curve.knots, [mapping])
    pieces = composed_pieces(curve, mapping, ends)
    degree = pieces.shape[1] - 1
    control = np.concatenate([pieces[:, :-1].reshape(-1, curve.dimension), pieces[-1, -1:]])
    knots = np.concatenate([np.zeros(degree + 1), np.repeat(ends[1:-1], degree), np.ones(degree + 1)])
    return BSplineCurve(degree, knots, control)


def _binomials(n: int) -> Floats:
    return np.asarray(comb(n, np.arange(n + 1)))
