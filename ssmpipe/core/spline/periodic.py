"""Least-squares fit by a periodic spline, and its clamped form."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from scipy.interpolate import BSpline

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import gauss_rule, periodic_design_matrix


def periodic_coefficients(points: Floats, u: Floats, degree: int, n_spans: int, fairness: float = 0.0) -> Floats:
    """Return the coefficients of the periodic spline on equal spans that is nearest to points in the mean square.

    Parameters
    ----------
    points : (n, d) float64
    u : (n,) float64
        Parameters of the points, modulo 1.
    degree : int
    n_spans : int
    fairness : float, default=0
        Weight of ``integral |C''|^2`` beside the mean square distance.

    Returns
    -------
    (n_spans, d) float64
        As in :func:`ssmpipe.core.spline.basis.periodic_design_matrix`.

    Raises
    ------
    GeometryError
        If the points do not determine them.
    """
    basis = periodic_design_matrix(u, n_spans, degree)
    normal = basis.T @ basis / len(points)
    if fairness > 0 and degree > 1:
        nodes, weights = gauss_rule(np.linspace(0.0, 1.0, n_spans + 1), degree)
        bending = periodic_design_matrix(nodes, n_spans, degree, 2)
        normal = normal + fairness * bending.T @ (weights[:, None] * bending)
    try:
        factor = scipy.linalg.cho_factor(normal)
        pivots = np.diag(factor[0])
        if pivots.min() < 1e-7 * pivots.max():
            raise np.linalg.LinAlgError
    except np.linalg.LinAlgError:
        raise GeometryError(
            f"{len(points)} points, unevenly spaced, do not determine {n_spans} spans of a closed curve",
            "use fewer control points, give more points, or fairness above 0",
        ) from None
    return np.asarray(scipy.linalg.cho_solve(factor, basis.T @ points / len(points)))


def clamped_control(coefficients: Floats, degree: int) -> Floats:
    """Return the control points of the same curve on uniform clamped knots, by knot insertion at the seam (Boehm 1980).

    Parameters
    ----------
    coefficients : (n_spans, d) float64
    degree : int

    Returns
    -------
    (n_spans + degree, d) float64
        The first and the last are the same numbers.

    Examples
    --------
    >>> clamped_control(np.array([[0.0], [1.0], [2.0]]), 2).ravel()
    array([0.5, 1. , 2. , 0. , 0.5])
    """
    n_spans = len(coefficients)
    knots = np.arange(-degree, n_spans + degree + 1) / n_spans
    spline = BSpline(knots, coefficients[np.arange(n_spans + degree) % n_spans], degree)
    if degree > 1:
        spline = spline.insert_knot(0.0, degree - 1).insert_knot(1.0, degree - 1)
    first = int(np.searchsorted(spline.t, 0.0, side="right")) - 1 - degree
    last = int(np.searchsorted(spline.t, 1.0, side="left")) - 1
    control = spline.c[first : last + 1].copy()
    control[-1] = control[0]
    return np.asarray(control)
