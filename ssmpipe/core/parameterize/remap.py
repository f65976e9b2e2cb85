"""Monotone changes of u and v alone that lower the stretch of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import face_areas
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.periodic import folded_periodic, periodic_stretch, pole_faces, squared_derivatives

DEGREE = 2
N_STRIPS = 8
BARRIER = 1e-4


@dataclass(frozen=True, eq=False)
class Remap:
    """An increasing function of one parameter: the integral of a positive B-spline.

    Parameters
    ----------
    coefficients : (n,) float64
        Of the derivative, positive, so that the derivative is.
    periodic : bool
        Whether the derivative has period 1; the function then gains 1 per period.

    Examples
    --------
    >>> Remap(np.ones(6), periodic=True)(np.array([-0.5, 0.25, 1.5]))
    array([-0.5 ,  0.25,  1.5 ])
    """

    coefficients: Floats
    periodic: bool

    def __call__(self, parameter: Floats) -> Floats:
        """Return the new parameter."""
        knots, fold = _knots(len(self.coefficients), self.periodic)
        spline = BSpline(knots, fold @ self.coefficients, DEGREE)
        integral = spline.antiderivative()
        start, end = float(integral(0.0)), float(integral(1.0))
        whole = np.floor(parameter) if self.periodic else np.zeros(len(parameter))
        return np.asarray(whole + (integral(parameter - whole) - start) / (end - start))

    def blended(self, share: float) -> Remap:
        """Return the mean of this function and the identity; ``share`` = 0 is the identity."""
        mean = float(_integrals(len(self.coefficients), self.periodic) @ self.coefficients)
        return Remap(share * self.coefficients / mean + (1.0 - share), self.periodic)


def best_remap(
    parameter: Floats, energy: Floats, n_coefficients: int, periodic: bool, *, max_iterations: int = 60
) -> Remap:
    """Return the increasing function t(v) with the least energy ``sum_k energy_k / t'(parameter_k)^2``.

    That is the integral of the squared derivative |S_t|^2 over the surface when ``energy`` is that of |S_v|^2, split up by v. Among
    all functions the best one has ``t' ~ (energy density)^(1/3)``; here t' is a B-spline. The problem is convex in the
    coefficients: Newton's method with a weak logarithmic barrier that keeps them positive.

    Parameters
    ----------
    parameter : (n,) float64
        In [0, 1]; modulo 1 if periodic.
    energy : (n,) float64
        Not negative.
    n_coefficients : int
    periodic : bool
    """
    knots, fold = _knots(n_coefficients, periodic)
    wrapped = parameter % 1.0 if periodic else np.clip(parameter, 0.0, 1.0)
    basis = BSpline.design_matrix(wrapped, knots, DEGREE) @ fold
    integrals = _integrals(n_coefficients, periodic)
    share = energy / energy.sum()
    c = np.ones(n_coefficients)

    def objective(c: Floats) -> float:
        return float((share / (basis @ c) ** 2).sum() + 2.0 * integrals @ c - BARRIER * integrals @ np.log(c))

    value = objective(c)
    for _ in range(max_iterations):
        h = basis @ c
        gradient = basis.T @ (-2.0 * share / h**3) + integrals * (2.0 - BARRIER / c)
        hessian = basis.T @ ((6.0 * share / h**4)[:, None] * basis) + np.diag(BARRIER * integrals / c**2)
        step = -np.linalg.solve(hessian, gradient)
        shrinking = step < 0
        length = min(1.0, 0.95 * float((-c[shrinking] / step[shrinking]).min())) if shrinking.any() else 1.0
        decrease = float(gradient @ step)
        while length > 1e-12 and not objective(c + length * step) <= value + 1e-4 * length * decrease:
            length *= 0.5
        if length <= 1e-12:
            break
        c = c + length * step
        value = objective(c)
        if -decrease < 1e-12:
            break
    return Remap(c / float(integrals @ c), periodic)


def remap_periodic(
    mesh: TriMesh, uv: Floats, poles: tuple[int, ...], *, n_coefficients: int = 10, max_rounds: int = 5
) -> tuple[Floats, Floats]:
    """Change u and v of a periodic map by one function each, so that its stretch is least (Li 2015, section 5.2.4).

    Rounds are repeated while the stretch falls by more than a thousandth: the second one refines where the first has made room. A
    round that would turn a triangle over is blended with the identity.

    Returns
    -------
    uv : (n_vertices, 2) float64
    stretch : (n_rounds + 1,) float64
        :func:`~ssmpipe.core.parameterize.periodic.periodic_stretch` before and after each round.
    """
    stretch = [periodic_stretch(mesh, uv, poles)]
    for _ in range(max_rounds):
        places, energy_u, energy_v = _energies(mesh, uv, poles)
        change_u = best_remap(places[:, 0], energy_u, n_coefficients, True)
        change_v = best_remap(places[:, 1], energy_v, n_coefficients, False)
        candidate, share = uv, 1.0
        while share > 0.1:
            candidate = np.column_stack([change_u.blended(share)(uv[:, 0]), change_v.blended(share)(uv[:, 1])])
            if not folded_periodic(mesh, candidate, poles).any():
                break
            share *= 0.5
        value = periodic_stretch(mesh, candidate, poles)
        if not value < stretch[-1]:
            break
        uv = candidate
        stretch.append(value)
        if value > (1.0 - 1e-3) * stretch[-2]:
            break
    return uv, np.array(stretch)


def _energies(mesh: TriMesh, uv: Floats, poles: tuple[int, ...]) -> tuple[Floats, Floats, Floats]:
    """Return places (n, 2) in the square and the integrals of |S_u|^2 and |S_v|^2 that belong to them, (n,) each."""
    square_u, square_v = squared_derivatives(mesh, uv, poles)
    areas = face_areas(mesh)
    at, base, pole = pole_faces(mesh.faces, poles)
    plain = np.setdiff1d(np.arange(mesh.n_faces), at)
    # three inner points per triangle; a patch at a pole is long in v and is cut into strips
    inner = np.full((3, 3), 1.0 / 6.0) + 0.5 * np.eye(3)
    places = [np.einsum("kc,fcd->fkd", inner, uv[mesh.faces[plain]]).reshape(-1, 2)]
    energy_u, energy_v = ([np.repeat((areas * s)[plain] / 3.0, 3)] for s in (square_u, square_v))
    t = (np.arange(N_STRIPS) + 0.5) / N_STRIPS
    width = 2.0 * (1.0 - t) / N_STRIPS
    middle = uv[base].mean(axis=1)
    v = (1.0 - t) * middle[:, 1:] + t * uv[pole, 1][:, None]
    places.append(np.column_stack([np.repeat(middle[:, 0], N_STRIPS), v.ravel()]))
    energy_u.append(((areas * square_u)[at][:, None] * width * 2.0 * (1.0 - t) ** 2).ravel())
    energy_v.append(((areas * square_v)[at][:, None] * width).ravel())
    return np.concatenate(places), np.concatenate(energy_u), np.concatenate(energy_v)


def _knots(n: int, periodic: bool) -> tuple[Floats, Floats]:
    """Return knots on [0, 1] and the matrix from the n free coefficients to those of the spline."""
    if not periodic:
        inner = np.linspace(0.0, 1.0, n - DEGREE + 1)
        return np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)]), np.eye(n)
    knots = np.arange(-DEGREE, n + DEGREE + 1) / n
    return knots, np.eye(n)[np.arange(n + DEGREE) % n]


def _integrals(n: int, periodic: bool) -> Floats:
    knots, fold = _knots(n, periodic)
    integrals = np.array([BSpline(knots, row, DEGREE).integrate(0.0, 1.0) for row in np.eye(len(knots) - DEGREE - 1)])
    return np.asarray(integrals @ fold)
