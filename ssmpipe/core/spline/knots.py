"""Clamped knot vectors on the unit interval, and what follows from them alone."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError


def clamped_uniform_knots(n_control: int, degree: int) -> Floats:
    """Return the clamped knot vector with equal spans for ``n_control`` control points.

    Parameters
    ----------
    n_control : int
        Number of control points; at least ``degree + 1``.
    degree : int

    Returns
    -------
    (n_control + degree + 1,) float64

    Raises
    ------
    GeometryError
        If there are too few control points for the degree.

    Examples
    --------
    >>> clamped_uniform_knots(4, 2)
    array([0. , 0. , 0. , 0.5, 1. , 1. , 1. ])
    """
    if degree < 1 or n_control < degree + 1:
        raise GeometryError(
            f"a spline of degree {degree} needs degree >= 1 and at least {degree + 1} control points, got {n_control}"
        )
    inner = np.linspace(0.0, 1.0, n_control - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])


def greville(knots: Floats, degree: int) -> Floats:
    """Return the Greville abscissae, the coefficients of the identity map (Piegl and Tiller 1997, sec. 9.1).

    Parameters
    ----------
    knots : (n_control + degree + 1,) float64
    degree : int

    Returns
    -------
    (n_control,) float64

    Examples
    --------
    >>> greville(clamped_uniform_knots(4, 2), 2)
    array([0.  , 0.25, 0.75, 1.  ])
    """
    n_control = len(knots) - degree - 1
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)[:n_control]
    return windows.mean(axis=1)


def breakpoints(knots: Floats) -> Floats:
    """Return the distinct knots: the ends of the polynomial pieces.

    Examples
    --------
    >>> breakpoints(clamped_uniform_knots(4, 2))
    array([0. , 0.5, 1. ])
    """
    return np.unique(knots)


def find_spans(knots: Floats, degree: int, parameters: Floats) -> Ints:
    """Return for every parameter the knot index ``k`` with ``knots[k] <= u < knots[k + 1]``; u = 1 joins the last span.

    Examples
    --------
    >>> find_spans(clamped_uniform_knots(4, 2), 2, np.array([0.0, 0.5, 1.0]))
    array([2, 3, 3])
    """
    n_control = len(knots) - degree - 1
    return np.clip(np.searchsorted(knots, parameters, side="right") - 1, degree, n_control - 1).astype(np.int64)


def check_clamped_knots(knots: Floats, degree: int, n_control: int, name: str) -> None:
    """Check the length, order and ends of a knot vector.

    Raises
    ------
    GeometryError
        With the name of the knot vector and the counts.
    """
    if knots.shape != (n_control + degree + 1,):
        raise GeometryError(f"{name}: got {knots.size} knots, need n_control + degree + 1 = {n_control + degree + 1}")
    if np.any(np.diff(knots) < 0):
        raise GeometryError(f"{name}: knots must not decrease")
    if not (np.all(knots[: degree + 1] == 0) and np.all(knots[-degree - 1 :] == 1)):
        raise GeometryError(f"{name}: the first and last {degree + 1} knots must be 0 and 1 (clamped)")
