"""Quadrature on the parameter domain: sample, mid-point and Gauss rules per direction, and their tensor product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias, overload

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.covariance.composition import refined_breakpoints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import gauss_rule
from ssmpipe.core.spline.curve import BSplineCurve

NodesAndWeights: TypeAlias = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Rule:
    """Points of the parameter domain and what each one weighs.

    Parameters
    ----------
    parameters : (n_P, d_par) float64
        In the unit interval or square; the last direction runs fastest.
    weights : (n_P,) float64
        Sum 1.
    """

    parameters: Floats
    weights: Floats


def uniform(n: int) -> NodesAndWeights:
    """Return ``n`` evenly spaced nodes, ends included, of equal weight: the discrete formulation (Li 2015, [1.20a]).

    It is no quadrature rule of order two: the ends weigh as much as the rest, so its error is of order ``1/n``.

    Examples
    --------
    >>> uniform(3)
    (array([0. , 0.5, 1. ]), array([0.33333333, 0.33333333, 0.33333333]))
    """
    _check_count(n)
    return np.linspace(0.0, 1.0, n), np.full(n, 1.0 / n)


def midpoints(n: int) -> NodesAndWeights:
    """Return the middles of ``n`` equal intervals (Li 2015, [3.12]); exact for degree 1, error ``O(1/n^2)``.

    Examples
    --------
    >>> midpoints(2)
    (array([0.25, 0.75]), array([0.5, 0.5]))
    """
    _check_count(n)
    return (np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)


def gauss(breakpoints: Floats, n_per_span: int) -> NodesAndWeights:
    """Return Gauss-Legendre nodes and weights on every span; exact for piecewise degree ``2 n_per_span - 1``.

    Parameters
    ----------
    breakpoints : (m,) float64
        Ends of the polynomial pieces, or a whole knot vector.
    n_per_span : int

    Examples
    --------
    >>> nodes, weights = gauss(np.array([0, 0.5, 1]), 2)
    >>> bool(np.isclose(weights @ nodes**3, 0.25))
    True
    """
    _check_count(n_per_span)
    return gauss_rule(breakpoints, n_per_span)


def gauss_refined(shape_knots: Floats, maps: Sequence[BSplineCurve], n_per_span: int) -> NodesAndWeights:
    """Return Gauss nodes and weights on the spans over which every reparameterized curve is one polynomial.

    Parameters
    ----------
    shape_knots : (m,) float64
        Knots of the curves ``S_i``.
    maps : sequence of BSplineCurve
        The reparameterizations ``D_i``; dimension 1, increasing, from 0 to 1.
    n_per_span : int

    Returns
    -------
    nodes, weights : (n_spans * n_per_span,) float64
        The spans end at the knots of the ``D_i`` and where a ``D_i`` meets a knot of the curves (Li 2015, [3.31]).

    Raises
    ------
    FoldoverError
        If a ``D_i`` is not increasing.
    """
    return gauss(refined_breakpoints(shape_knots, maps), n_per_span)


def tensor(*rules: NodesAndWeights) -> Rule:
    """Return the tensor product of one rule per direction.

    Examples
    --------
    >>> tensor(midpoints(1), midpoints(2)).parameters
    array([[0.5 , 0.25],
           [0.5 , 0.75]])
    """
    grids = np.meshgrid(*(nodes for nodes, _ in rules), indexing="ij")
    weights = reduce(np.multiply.outer, [w for _, w in rules])
    return Rule(np.stack([g.ravel() for g in grids], axis=-1), np.ravel(weights))


@overload
def gauss_points_for_exact(degree_shape: int, degree_reparameterization: int | None = None) -> int: ...
@overload
def gauss_points_for_exact(
    degree_shape: tuple[int, ...], degree_reparameterization: tuple[int, ...] | None = None
) -> tuple[int, ...]: ...
def gauss_points_for_exact(
    degree_shape: int | tuple[int, ...], degree_reparameterization: int | tuple[int, ...] | None = None
) -> int | tuple[int, ...]:
    """Return how many Gauss points per span and direction integrate formulation I exactly (Li 2015, table 3.2).

    Parameters
    ----------
    degree_shape : int or (int,) or (int, int)
        Of the curves or surfaces.
    degree_reparameterization : the same, optional
        Of the reparameterizations; None without them.

    Returns
    -------
    int or tuple of int
        ``p + 1``; with a reparameterization of degree ``d`` on the refined spans ``p d + 1``.

    Notes
    -----
    A reparameterized surface is polynomial on the spans of ``D`` only if it is one Bezier patch. Both components of ``D``
    depend on ``u``, so ``u^p v^q`` becomes degree ``(p + q) d`` in ``u``, and ``(p + q) d + 1`` points are needed.
    The ``p d + 1`` of table 3.2 holds only where each component of ``D`` depends on its own parameter alone.

    Examples
    --------
    >>> gauss_points_for_exact(2), gauss_points_for_exact(2, 3), gauss_points_for_exact((2, 2)), gauss_points_for_exact((2, 1), (2, 2))
    (3, 7, (3, 3), (7, 7))
    """
    if isinstance(degree_shape, int):
        return degree_shape * _single(degree_reparameterization) + 1
    if degree_reparameterization is None:
        return tuple(p + 1 for p in degree_shape)
    if isinstance(degree_reparameterization, int) or len(degree_reparameterization) != len(degree_shape):
        raise GeometryError(
            f"degrees {degree_shape} and {degree_reparameterization} differ in their number of directions"
        )
    total = sum(degree_shape)
    return tuple(total * d + 1 for d in degree_reparameterization)


def _single(degree: int | tuple[int, ...] | None) -> int:
    if degree is None:
        return 1
    if not isinstance(degree, int):
        raise GeometryError(f"a curve has one degree of reparameterization, got {degree}")
    return degree


def _check_count(n: int) -> None:
    if n < 1:
        raise GeometryError(f"a quadrature rule needs at least 1 node, got {n}")
