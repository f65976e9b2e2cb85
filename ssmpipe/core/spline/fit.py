"""Least-squares fit of a tensor-product B-spline to a grid of points, interpolating the ends."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix, gauss_rule
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.periodic import clamped_control, periodic_coefficients
from ssmpipe.core.spline.poles import smooth_pole
from ssmpipe.core.spline.surface import BSplineSurface


def end_interpolating_solver(parameters: Floats, knots: Floats, degree: int, *, fairness: float = 0.0) -> Floats:
    """Return the matrix that maps data to the control points of the end-interpolating least-squares curve.

    Minimizes ``mean_i |C(u_i) - x_i|^2 + fairness * integral |C''|^2`` with ``C(0) = x_0`` and ``C(1) = x_n`` kept exactly
    (Piegl and Tiller 1997, sec. 9.4).

    Parameters
    ----------
    parameters : (n,) float64
        Increasing, from 0 to 1.
    knots : (n_control + degree + 1,) float64
    degree : int
    fairness : float, default=0

    Returns
    -------
    (n_control, n) float64

    Raises
    ------
    GeometryError
        If there are fewer data than control points or a knot span holds too few of them.
    """
    n_control = len(knots) - degree - 1
    basis = design_matrix(parameters, knots, degree)
    n = len(parameters)
    solver = np.zeros((n_control, n))
    solver[0, 0] = solver[-1, -1] = 1.0
    inner = basis[:, 1:-1]
    normal = inner.T @ inner / n
    right = inner.T @ (np.eye(n) - basis[:, [0, -1]] @ solver[[0, -1]]) / n
    if fairness > 0:
        nodes, weights = gauss_rule(knots, degree)
        bending = design_matrix(nodes, knots, degree, 2)
        energy = bending.T @ (weights[:, None] * bending) * fairness
        normal = normal + energy[1:-1, 1:-1]
        right = right - energy[1:-1][:, [0, -1]] @ solver[[0, -1]]
    try:
        factor = scipy.linalg.cho_factor(normal)
    except np.linalg.LinAlgError:
        raise GeometryError(
            f"{n} samples do not determine {n_control} control points of degree {degree}",
            "sample more densely or use fewer control points",
        ) from None
    solver[1:-1] = scipy.linalg.cho_solve(factor, right)
    return solver


def fit_surface(
    samples: Floats,
    *,
    degree: tuple[int, int] = (2, 2),
    n_control: tuple[int, int] = (60, 60),
    fairness: float = 0.0,
    smooth: bool = True,
) -> BSplineSurface:
    """Fit a B-spline surface to samples on a regular grid of the unit square.

    The four boundary curves are fitted from the boundary samples alone and pass through the corner samples; so two fits
    that share a row of samples share the boundary curve exactly. Where the first and the last row are equal the surface closes
    exactly, and a column of equal samples stays one point, a pole.

    Parameters
    ----------
    samples : (m_u, m_v, d) float64
        Evenly spaced in both parameters, ends included [mm].
    degree : (int, int), default=(2, 2)
    n_control : (int, int), default=(60, 60)
    fairness : float, default=0
        Weight of the squared second derivative per direction; 0 is a pure least-squares fit.
    smooth : bool, default=True
        A surface that closes is periodic of order ``C^(degree - 1)``, the seam included, and differentiable at a pole
        (:func:`~ssmpipe.core.spline.poles.smooth_pole`). Otherwise it passes through the samples of the seam and has an
        edge there.

    Returns
    -------
    BSplineSurface
        Uniform clamped knots.

    Raises
    ------
    GeometryError
        If there are fewer samples than control points in a direction.

    Notes
    -----
    The problem separates by direction, so two small solves serve all coordinates. Error ``O(h^(p+1))`` on smooth data.

    Examples
    --------
    >>> u, v = np.meshgrid(np.linspace(0, 1, 20), np.linspace(0, 1, 20), indexing="ij")
    >>> surface = fit_surface(np.stack([u, v, u * v], axis=-1), n_control=(5, 5))
    >>> bool(np.allclose(surface.control_points[-1, -1], [1, 1, 1]))
    True
    """
    closes = np.array_equal(samples[0], samples[-1])
    solvers = []
    knots = []
    for axis in range(2):
        m, n = samples.shape[axis], n_control[axis]
        if m < n:
            raise GeometryError(
                f"{m} samples cannot determine {n} control points", "sample more densely or use fewer control points"
            )
        knots.append(clamped_uniform_knots(n, degree[axis]))
        t = np.linspace(0, 1, m)
        if axis == 0 and closes and smooth:
            if n < degree[0] + 3:
                raise GeometryError(
                    f"{n} control points are too few around a surface that closes", f"at least {degree[0] + 3}"
                )
            ring = periodic_coefficients(np.eye(m - 1), t[:-1], degree[0], n - degree[0], fairness)
            # the last sample is the first one again
            solvers.append(np.column_stack([clamped_control(ring, degree[0]), np.zeros(n)]))
        else:
            solvers.append(end_interpolating_solver(t, knots[axis], degree[axis], fairness=fairness))
    rows = np.tensordot(solvers[0], samples, axes=(1, 0))
    control = np.moveaxis(np.tensordot(solvers[1], rows, axes=(1, 1)), 0, 1)
    # where the samples close, the surface closes to the bit: products of equal rows may differ in the last one
    if closes:
        control[-1] = control[0]
    for column in (0, -1):
        if (samples[:, column] == samples[0, column]).all():
            control[:, column] = samples[0, column]
            if closes and smooth and samples.shape[2] == 3:
                turn = 2.0 * np.pi * np.linspace(0, 1, samples.shape[0])
                circle = solvers[0] @ np.stack([np.cos(turn), np.sin(turn)], axis=1)
                control = smooth_pole(control, column, circle)
    return BSplineSurface(degree, knots[0], knots[1], control)


def surface_grid(surface: BSplineSurface, n_u: int, n_v: int) -> Floats:
    """Return the (n_u, n_v, d) points of a surface on a regular parameter grid."""
    basis_u = design_matrix(np.linspace(0, 1, n_u), surface.knots_u, surface.degree[0])
    basis_v = design_matrix(np.linspace(0, 1, n_v), surface.knots_v, surface.degree[1])
    return np.einsum("ka,abd,lb->kld", basis_u, surface.control_points, basis_v, optimize=True)


def interpolating_surface(points: Floats, *, closed_u: bool = False) -> BSplineSurface:
    """Return the bicubic B-spline surface through a grid of points, with as many control points.

    Parameters
    ----------
    points : (n_u, n_v, d) float64
        At even parameters, at least 4 in each direction.
    closed_u : bool, default=False
        Whether the last row is joined to the first one, which is stored once.

    Examples
    --------
    >>> grid = np.random.default_rng(0).normal(size=(6, 5, 3))
    >>> surface = interpolating_surface(grid)
    >>> bool(np.allclose(surface_grid(surface, 6, 5), grid))
    True
    """
    rows = np.concatenate([points, points[:1]]) if closed_u else points
    return fit_surface(rows, degree=(3, 3), n_control=(rows.shape[0], rows.shape[1]), smooth=False)
