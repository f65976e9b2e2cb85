"""Least-squares fit of a B-spline curve, open or closed, to ordered points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConvergenceError, GeometryError
from ssmpipe.core.spline.arc_length import arc_length_at
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.fit import end_interpolating_solver
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.periodic import clamped_control, periodic_coefficients

Spacing: TypeAlias = Literal["arc-length", "chord", "centripetal", "uniform"]

_EXPONENTS = {"arc-length": 1.0, "chord": 1.0, "centripetal": 0.5, "uniform": 0.0}
_MORE_DATA = "use fewer control points, give more points, or fairness above 0"


def data_parameters(points: Floats, spacing: Spacing = "chord", *, closed: bool = False) -> Floats:
    """Return a parameter in [0, 1] for every point from its distances to its neighbours.

    Parameters
    ----------
    points : (n, d) float64
        Ordered, neighbours distinct; of a closed curve the first is not repeated.
    spacing : {"chord", "arc-length", "centripetal", "uniform"}
        Steps proportional to the distance (``arc-length`` starts from these), to its square root (Lee 1989), or equal.
    closed : bool, default=False

    Returns
    -------
    (n,) float64
        From 0 to 1; below 1 when closed, where 1 stands for the first point again.

    Raises
    ------
    GeometryError
        If there are too few points or neighbours coincide.

    Examples
    --------
    >>> data_parameters(np.array([[0, 0], [1, 0], [1, 4.0]]), "centripetal").round(6)
    array([0.      , 0.333333, 1.      ])
    """
    least = 3 if closed else 2
    if len(points) < least:
        raise GeometryError(f"{len(points)} points make no curve", f"give at least {least}")
    ring = np.concatenate([points, points[:1]]) if closed else points
    steps = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    if np.any(steps == 0):
        raise GeometryError(f"point {int(np.argmin(steps))} coincides with the next one", "remove repeated points")
    sums = np.concatenate([[0.0], np.cumsum(steps ** _EXPONENTS[spacing])])
    return np.asarray(sums[: len(points)] / sums[-1])


def clamp_periodic(coefficients: Floats, degree: int) -> BSplineCurve:
    """Write a periodic spline on equal spans as a clamped one, exactly, by knot insertion at the seam (Boehm 1980).

    Parameters
    ----------
    coefficients : (n_spans, d) float64
        As in :func:`ssmpipe.core.spline.basis.periodic_design_matrix`.
    degree : int

    Returns
    -------
    BSplineCurve
        ``n_spans + degree`` control points on uniform clamped knots; the first and the last are the same numbers.

    Examples
    --------
    >>> clamp_periodic(np.array([[0.0], [1.0], [2.0]]), 2).control_points.ravel()
    array([0.5, 1. , 2. , 0. , 0.5])
    """
    n_control = len(coefficients) + degree
    return BSplineCurve(degree, clamped_uniform_knots(n_control, degree), clamped_control(coefficients, degree))


def fit_curve(
    points: Floats,
    *,
    degree: int = 2,
    n_control: int = 40,
    closed: bool = False,
    parameters: Spacing | Floats = "arc-length",
    fairness: float = 0.0,
) -> BSplineCurve:
    """Fit a B-spline curve to ordered points by least squares (Piegl and Tiller 1997, sec. 9.4; Li 2015, sec. 3.4.1).

    An open curve passes through the first and the last point. A closed curve is periodic of order ``C^(degree-1)``, the seam
    included, and is returned in clamped form with first = last control point.

    Parameters
    ----------
    points : (n, d) float64
        Ordered; of a closed curve the first is not repeated.
    degree : int, default=2
    n_control : int, default=40
        Control points of the clamped form: ``n_control - degree`` equal knot spans.
    closed : bool, default=False
    parameters : {"arc-length", "chord", "centripetal", "uniform"} or (n,) float64
        Of the points, see :func:`data_parameters`. ``arc-length`` repeats the fit with the parameters that the fitted curve
        itself gives, until they settle: the curve then has nearly constant speed whatever the spacing of the points.
        It stops early where sparse points make the curve oscillate between them.
    fairness : float, default=0
        Weight of ``integral |C''|^2`` beside the mean square distance. 1e-12 changes nothing that can be seen, but bridges
        spans without points.

    Returns
    -------
    BSplineCurve

    Raises
    ------
    GeometryError
        If the points do not determine the control points, or parameters are not increasing in [0, 1].

    Notes
    -----
    The error falls as ``n_control^-(degree + 1)`` on smooth data.

    Examples
    --------
    >>> t = 2 * np.pi * np.arange(200) / 200
    >>> circle = fit_curve(np.column_stack([np.cos(t), np.sin(t)]), n_control=20, closed=True)
    >>> bool(np.all(circle.control_points[0] == circle.control_points[-1]))
    True
    """
    points = np.asarray(points, dtype=np.float64)
    if n_control < degree + (3 if closed else 1):
        raise GeometryError(f"{n_control} control points are too few for degree {degree}", f"at least {degree + 3}")
    if len(points) < n_control - (degree if closed else 0) and fairness == 0:
        raise GeometryError(f"{len(points)} points cannot determine {n_control} control points", _MORE_DATA)
    if not isinstance(parameters, str):
        return _fit(points, _checked(parameters, len(points), closed), degree, n_control, closed, fairness)
    u = data_parameters(points, parameters, closed=closed)
    curve = _fit(points, u, degree, n_control, closed, fairness)
    square = ((curve_points(curve, u) - points) ** 2).sum()
    for _ in range(5 if parameters == "arc-length" else 0):
        lengths, total = arc_length_at(curve, u)
        refined = lengths / total
        candidate = _fit(points, refined, degree, n_control, closed, fairness)
        residual = ((curve_points(candidate, refined) - points) ** 2).sum()
        if residual > 4 * square + 1e-20 * total**2:
            break
        change = float(np.abs(refined - u).max())
        curve, u = candidate, refined
        if change < 1e-12:
            break
    return curve


def fewest_control_points(distance: Callable[[int], float], tolerance: float, *, least: int, most: int) -> int:
    """Return a number of control points that keeps a tolerance where one fewer does not.

    The number is doubled until it suffices, then halved between; distances fall nearly everywhere with it, so that it is the smallest
    but for places where they do not.

    Parameters
    ----------
    distance : callable
        Of the curve with so many control points from what it is fitted to.
    tolerance : float
        In the same unit.
    least, most : int
        Numbers to choose from, both included.

    Raises
    ------
    ConvergenceError
        If ``most`` do not suffice.

    Examples
    --------
    >>> fewest_control_points(lambda n: 100.0 / n, 2.9, least=5, most=80)
    35
    """
    below, enough = least - 1, least
    while (left := distance(enough)) > tolerance:
        if enough >= most:
            raise ConvergenceError(
                f"{enough} control points leave a distance of {left:.3g}, more than the tolerance {tolerance:.3g}",
                "raise the tolerance, or give more points",
            )
        below, enough = enough, min(2 * enough, most)
    while enough - below > 1:
        middle = (below + enough) // 2
        if distance(middle) <= tolerance:
            enough = middle
        else:
            below = middle
    return enough


def curve_points(curve: BSplineCurve, parameters: Floats) -> Floats:
    """Return the (n, d) points of a curve at parameters in [0, 1].

    Examples
    --------
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.]), np.array([[0, 0], [3, 4.]]))
    >>> curve_points(line, np.array([0.5]))
    array([[1.5, 2. ]])
    """
    return np.asarray(design_matrix(parameters, curve.knots, curve.degree) @ curve.control_points)


def _checked(parameters: Floats, n_points: int, closed: bool) -> Floats:
    u = np.asarray(parameters, dtype=np.float64)
    ends = u.shape == (n_points,) and u[0] == 0.0 and (u[-1] < 1.0 if closed else u[-1] == 1.0)
    if not ends or np.any(np.diff(u) <= 0):
        where = "from 0 to below 1" if closed else "from 0 to 1"
        raise GeometryError(f"need {n_points} increasing parameters {where}, got shape {u.shape}")
    return u


def _fit(points: Floats, u: Floats, degree: int, n_control: int, closed: bool, fairness: float) -> BSplineCurve:
    if closed:
        return clamp_periodic(periodic_coefficients(points, u, degree, n_control - degree, fairness), degree)
    knots = clamped_uniform_knots(n_control, degree)
    if fairness == 0:
        _check_data_per_span(u, knots, degree)
    return BSplineCurve(degree, knots, end_interpolating_solver(u, knots, degree, fairness=fairness) @ points)


def _check_data_per_span(u: Floats, knots: Floats, degree: int) -> None:
    """Check that every inner control point has a data point of its own (Schoenberg and Whitney 1953)."""
    n_control = len(knots) - degree - 1
    at = 0
    for j in range(1, n_control - 1):
        at = max(at + 1, int(np.searchsorted(u, knots[j], side="right")))
        if at >= len(u) - 1 or u[at] >= knots[j + degree + 1]:
            raise GeometryError(
                f"{len(u)} points, unevenly spaced, do not determine {n_control} control points: "
                f"too few lie between parameters {knots[j]:.3g} and {knots[j + degree + 1]:.3g}",
                _MORE_DATA,
            )
