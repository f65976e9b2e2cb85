"""B-spline basis functions as matrices: values, derivatives, quadrature."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.knots import breakpoints


def design_matrix(parameters: Floats, knots: Floats, degree: int, derivative: int = 0) -> Floats:
    """Return the dense matrix of basis functions (or their derivatives) at ``parameters``.

    Parameters
    ----------
    parameters : (n,) float64
        In [0, 1].
    knots : (n_control + degree + 1,) float64
        Clamped.
    degree : int
    derivative : int, default=0
        Order of the derivative; rows are zero above the degree.

    Returns
    -------
    (n, n_control) float64
        Row i holds ``d^r B_k / du^r (u_i)`` (Piegl and Tiller 1997, eq. 2.7).

    Examples
    --------
    >>> from ssmpipe.core.spline.knots import clamped_uniform_knots
    >>> bool(np.allclose(design_matrix(np.linspace(0, 1, 5), clamped_uniform_knots(6, 2), 2).sum(axis=1), 1))
    True
    """
    if derivative > degree:
        return np.zeros((len(parameters), len(knots) - degree - 1))
    inner = knots[derivative : len(knots) - derivative]
    basis = np.asarray(BSpline.design_matrix(parameters, inner, degree - derivative).toarray())
    for order in range(derivative, 0, -1):
        basis = basis @ difference_matrix(knots[order - 1 : len(knots) - order + 1], degree - order + 1)
    return basis


def difference_matrix(knots: Floats, degree: int) -> Floats:
    """Return the matrix that maps control points to those of the derivative (Piegl and Tiller 1997, eq. 3.4).

    Examples
    --------
    >>> difference_matrix(np.array([0, 0, 0, 1, 1, 1.]), 2)
    array([[-2.,  2.,  0.],
           [ 0., -2.,  2.]])
    """
    n_control = len(knots) - degree - 1
    lengths = knots[degree + 1 : degree + n_control] - knots[1:n_control]
    factor = degree / lengths
    matrix = np.zeros((n_control - 1, n_control))
    rows = np.arange(n_control - 1)
    matrix[rows, rows] = -factor
    matrix[rows, rows + 1] = factor
    return matrix


def periodic_design_matrix(parameters: Floats, n_spans: int, degree: int, derivative: int = 0) -> Floats:
    """Return the (n, n_spans) periodic B-spline basis (or a derivative) on ``n_spans`` equal spans of [0, 1].

    Column j belongs to the basis function on the spans ``j - degree ... j``, modulo ``n_spans``.

    Examples
    --------
    >>> periodic_design_matrix(np.array([0.0, 1.0]), 4, 2)
    array([[0.5, 0.5, 0. , 0. ],
           [0.5, 0.5, 0. , 0. ]])
    """
    knots = np.arange(-degree, n_spans + degree + 1) / n_spans
    basis = design_matrix(parameters, knots, degree, derivative)
    folded = np.zeros((len(parameters), n_spans))
    for start in range(0, basis.shape[1], n_spans):
        part = basis[:, start : start + n_spans]
        folded[:, : part.shape[1]] += part
    return folded


def gauss_rule(knots: Floats, n_per_span: int) -> tuple[Floats, Floats]:
    """Return Gauss-Legendre nodes and weights on every span of a knot vector or of break points; exact for degree ``2 n_per_span - 1``.

    Returns
    -------
    nodes, weights : (n_spans * n_per_span,) float64
        The weights sum to 1.

    Examples
    --------
    >>> nodes, weights = gauss_rule(np.array([0, 0, 0.5, 1, 1]), 2)
    >>> bool(np.isclose(weights @ nodes**3, 0.25))
    True
    """
    nodes, weights = np.polynomial.legendre.leggauss(n_per_span)
    ends = breakpoints(knots)
    half = 0.5 * np.diff(ends)[:, None]
    centre = 0.5 * (ends[1:] + ends[:-1])[:, None]
    return (centre + half * nodes).ravel(), (half * weights).ravel()
