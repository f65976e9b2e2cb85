"""Covariance of a cohort as an integral over the parameter domain (formulation I): sampled, by Gauss, in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.covariance.composition import bezier_pieces, composed_pieces, refined_breakpoints
from ssmpipe.core.covariance.quadrature import Rule, gauss, gauss_points_for_exact, gauss_refined, midpoints, tensor
from ssmpipe.core.covariance.sampling import sample
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Spline, SplineStack
from ssmpipe.core.spline.knots import breakpoints


def weighted_covariance(points: Floats, weights: Floats) -> Floats:
    """Return ``sum_l w_l (x_i^l - mean) . (x_j^l - mean) / (n_S - 1)`` (Li 2015, [3.12]).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    weights : (n_P,) float64

    Returns
    -------
    (n_S, n_S) float64
        Squared units of the points. Its nonzero eigenvalues are those of the covariance of the shape vectors.

    Examples
    --------
    >>> weighted_covariance(np.array([[[0.0]], [[2.0]]]), np.array([1.0]))
    array([[ 1., -1.],
           [-1.,  1.]])
    """
    _check_cohort(len(points))
    centred = points - points.mean(axis=0)
    flat = centred.reshape(len(points), -1)
    return np.asarray((centred * weights[:, None]).reshape(len(points), -1) @ flat.T / (len(points) - 1))


def covariance_by_rule(splines: Sequence[Spline], rule: Rule, maps: Sequence[Spline] | None = None) -> Floats:
    """Return the (n_S, n_S) covariance of formulation I by any quadrature rule.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
    rule : Rule
    maps : sequence of splines, optional
        Reparameterizations ``D_i``, of dimension ``d_par``.
    """
    return weighted_covariance(sample(splines, rule.parameters, maps).points, rule.weights)


def covariance_midpoint(
    splines: Sequence[Spline], counts: Sequence[int], maps: Sequence[Spline] | None = None
) -> Floats:
    """Return the covariance of formulation I by the mid-point rule with ``counts`` points per direction [3.12]."""
    return covariance_by_rule(splines, tensor(*(midpoints(n) for n in counts)), maps)


def covariance_gauss(
    splines: Sequence[Spline], maps: Sequence[Spline] | None = None, n_per_span: Sequence[int] | None = None
) -> Floats:
    """Return the covariance of formulation I by Gauss quadrature per span.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
    maps : sequence of splines, optional
        For curves the spans are refined by the inverse images of the knots, so the result is exact. For surfaces they are
        refined by the knots of ``D`` only: exact for single Bezier patches, an approximation for others (Li 2015, table 3.2).
    n_per_span : sequence of int, optional
        Gauss points per span and direction; as many as :func:`gauss_points_for_exact` asks for if absent.
    """
    return covariance_by_rule(splines, gauss_rule_for(splines, maps, n_per_span), maps)


def gauss_rule_for(
    splines: Sequence[Spline], maps: Sequence[Spline] | None = None, n_per_span: Sequence[int] | None = None
) -> Rule:
    """Return the Gauss rule on the spans of the splines, refined by those of the reparameterizations."""
    first = splines[0]
    degrees = tuple(first.degrees)
    if n_per_span is None:
        n_per_span = gauss_points_for_exact(degrees, None if maps is None else tuple(maps[0].degrees))
    if maps is None:
        return tensor(*(gauss(k, n) for k, n in zip(first.knot_vectors, n_per_span, strict=True)))
    if len(degrees) == 1:
        curves = [m for m in maps if isinstance(m, BSplineCurve)]
        return tensor(gauss_refined(first.knot_vectors[0], curves, n_per_span[0]))
    knots = [np.union1d(a, b) for a, b in zip(first.knot_vectors, maps[0].knot_vectors, strict=True)]
    return tensor(*(gauss(k, n) for k, n in zip(knots, n_per_span, strict=True)))


def bernstein_gram(p: int) -> Floats:
    """Return the (p + 1, p + 1) inner products of the Bernstein polynomials of degree ``p`` on [0, 1] [3.4, 3.5].

    Examples
    --------
    >>> bernstein_gram(1) * 6
    array([[2., 1.],
           [1., 2.]])
    """
    i = np.arange(p + 1)
    single = comb(p, i)
    return np.asarray(np.outer(single, single) / (comb(2 * p, i[:, None] + i) * (2 * p + 1)))


def basis_gram(knots: Floats, degree: int) -> Floats:
    """Return the inner products of the B-spline basis functions in closed form, summed over the Bezier pieces.

    Parameters
    ----------
    knots : (n + degree + 1,) float64
        Clamped.
    degree : int

    Returns
    -------
    (n, n) float64
        ``integral B_k B_l du``; symmetric, banded, entries sum to 1.

    Examples
    --------
    >>> bool(np.isclose(basis_gram(np.array([0, 0, 0, 0.5, 1, 1, 1]), 2).sum(), 1.0))
    True
    """
    ends = breakpoints(knots)
    pieces = bezier_pieces(knots, degree, np.eye(len(knots) - degree - 1), ends)
    weighted = np.einsum("s,ab,sbl->sal", np.diff(ends), bernstein_gram(degree), pieces, optimize=True)
    return np.asarray(np.einsum("sak,sal->kl", pieces, weighted, optimize=True))


def covariance_exact(splines: Sequence[Spline]) -> Floats:
    """Return the covariance of formulation I in closed form, without sampling (Li 2015, [3.6, 3.8]).

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        At least two, of equal degree and knots; Bezier curves and patches are those without interior knots.

    Returns
    -------
    (n_S, n_S) float64

    Raises
    ------
    GeometryError
        If there are fewer than two or they cannot be compared.

    Examples
    --------
    >>> knots = np.array([0, 0, 1, 1.0])
    >>> lines = [BSplineCurve(1, knots, np.array([[0.0, 0.0], [1.0, y]])) for y in (-1.0, 1.0)]
    >>> bool(np.allclose(covariance_exact(lines), np.array([[1, -1], [-1, 1]]) / 3))
    True
    """
    SplineStack(splines)
    _check_cohort(len(splines))
    control = np.stack([s.control_points for s in splines])
    centred = control - control.mean(axis=0)
    spread = centred
    for axis, (knots, degree) in enumerate(zip(splines[0].knot_vectors, splines[0].degrees, strict=True), start=1):
        spread = np.moveaxis(np.tensordot(basis_gram(knots, degree), spread, axes=(1, axis)), 0, axis)
    return np.asarray(centred.reshape(len(splines), -1) @ spread.reshape(len(splines), -1).T / (len(splines) - 1))


def covariance_exact_reparameterized(curves: Sequence[BSplineCurve], maps: Sequence[BSplineCurve]) -> Floats:
    """Return the covariance of formulation I of the curves ``S_i(D_i(u))`` in closed form (Li 2015, [3.30]).

    All compositions are written on one set of spans, refined by the knots of every ``D_i`` and the inverse images of the
    curves' knots under every ``D_i``.

    Parameters
    ----------
    curves : sequence of BSplineCurve
        At least two, of equal degree and knots.
    maps : sequence of BSplineCurve
        One per curve; dimension 1, equal degree.

    Returns
    -------
    (n_S, n_S) float64

    Raises
    ------
    FoldoverError
        If a ``D_i`` is not increasing.
    GeometryError
        If the cohorts do not match.
    """
    SplineStack(curves)
    _check_cohort(len(curves))
    if len(maps) != len(curves):
        raise GeometryError(f"{len(maps)} reparameterizations for {len(curves)} curves")
    ends = refined_breakpoints(curves[0].knots, maps)
    pieces = np.stack([composed_pieces(c, m, ends) for c, m in zip(curves, maps, strict=True)])
    centred = pieces - pieces.mean(axis=0)
    gram = bernstein_gram(centred.shape[2] - 1)
    spread = np.einsum("s,ab,isbd->isad", np.diff(ends), gram, centred, optimize=True)
    return np.asarray(centred.reshape(len(curves), -1) @ spread.reshape(len(curves), -1).T / (len(curves) - 1))


def _check_cohort(n_shapes: int) -> None:
    if n_shapes < 2:
        raise GeometryError(f"a covariance needs at least two shapes, got {n_shapes}")
