"""The Jacobian determinant of a B-spline reparameterization in Bézier form.

``J = det dD/du`` is a piecewise polynomial of degree ``2p - 1`` per direction. On every knot-span rectangle it is given
exactly by its values at ``2p x 2p`` nodes, hence by ``2p x 2p`` Bernstein coefficients, and the smallest coefficient
bounds it from below (Li 2015, [2.10] and appendix C).
"""

from __future__ import annotations

import numpy as np
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.knots import breakpoints


def bernstein_matrix(t: Floats, degree: int) -> Floats:
    """Return the (n, degree + 1) Bernstein basis at ``t`` in [0, 1].

    Examples
    --------
    >>> bernstein_matrix(np.array([0.5]), 2)
    array([[0.25, 0.5 , 0.25]])
    """
    k = np.arange(degree + 1)
    return comb(degree, k) * t[:, None] ** k * (1.0 - t[:, None]) ** (degree - k)


class BezierJacobian:
    """Bernstein coefficients of ``det dD/du`` for many shapes at once, with their transpose.

    Parameters
    ----------
    knots : (knots_u, knots_v)
        Clamped knot vectors of ``D``.
    degree : int
        Degree p of ``D``; the Jacobian has degree ``2p - 1``.

    Examples
    --------
    >>> from ssmpipe.core.correspondence.reparameterization import Reparameterization
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> J = BezierJacobian(D.knots, 2).coefficients(D.identity()[None])
    >>> J.shape, bool(np.allclose(J, 1))
    ((1, 144), True)
    """

    def __init__(self, knots: tuple[Floats, ...], degree: int) -> None:
        self.degree = 2 * degree - 1
        m = 2 * degree
        t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(m) + 0.5) / m)
        to_bernstein = np.linalg.inv(bernstein_matrix(t, self.degree))
        values, slopes, extract = [], [], []
        for knot in knots:
            ends = breakpoints(knot)
            nodes = (ends[:-1, None] + np.diff(ends)[:, None] * t).ravel()
            values.append(design_matrix(nodes, knot, degree))
            slopes.append(design_matrix(nodes, knot, degree, 1))
            extract.append(np.kron(np.eye(len(ends) - 1), to_bernstein))
        self.n_spans = tuple(len(breakpoints(k)) - 1 for k in knots)
        self._values, self._slopes, self._extract = tuple(values), tuple(slopes), tuple(extract)

    def _gradients(self, coefficients: Floats) -> tuple[Floats, Floats]:
        """Return ``D_u`` and ``D_v`` at the nodes, each (n_S, 2, n_nodes_u, n_nodes_v)."""
        c = np.moveaxis(coefficients, -1, 1)
        return self._slopes[0] @ c @ self._values[1].T, self._values[0] @ c @ self._slopes[1].T

    def coefficients(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n_z) Bernstein coefficients of J from the (n_S, n_b1, n_b2, 2) coefficients of D."""
        du, dv = self._gradients(coefficients)
        det = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
        return (self._extract[0] @ det @ self._extract[1].T).reshape(len(det), -1)

    def patches(self, flat: Floats) -> Floats:
        """Reshape (n_S, n_z) coefficients to (n_S, n_spans_u, n_spans_v, 2p, 2p)."""
        m = self.degree + 1
        return flat.reshape(-1, self.n_spans[0], m, self.n_spans[1], m).transpose(0, 1, 3, 2, 4)

    def pull_back(self, coefficients: Floats, weights: Floats) -> Floats:
        """Return ``sum_z weights_z dJ_z/db``, shape of ``coefficients``; ``weights`` is (n_S, n_z)."""
        du, dv = self._gradients(coefficients)
        n = (len(coefficients), self._extract[0].shape[0], self._extract[1].shape[0])
        back = self._extract[0].T @ weights.reshape(n) @ self._extract[1]
        grad = np.empty_like(np.moveaxis(coefficients, -1, 1))
        su, sv, vu, vv = self._slopes[0], self._slopes[1], self._values[0], self._values[1]
        grad[:, 0] = su.T @ (back * dv[:, 1]) @ vv - vu.T @ (back * du[:, 1]) @ sv
        grad[:, 1] = vu.T @ (back * du[:, 0]) @ sv - su.T @ (back * dv[:, 0]) @ vv
        return np.moveaxis(grad, 1, -1)

    def along(self, coefficients: Floats, direction: Floats, current: Floats) -> tuple[Floats, Floats]:
        """Return ``J1, J2`` with ``J(b + a d) = J(b) + a J1 + a^2 J2`` exactly; ``current`` is ``J(b)``."""
        second = self.coefficients(direction)
        first = self.coefficients(coefficients + direction) - current - second
        return first, second

    def rows(self, coefficients: Floats) -> Floats:
        """Return dJ_z/db of one shape, (n_z, n_b1 * n_b2 * 2), for Gauss-Newton blocks."""
        du, dv = self._gradients(coefficients[None])
        su, sv, vu, vv = self._slopes[0], self._slopes[1], self._values[0], self._values[1]

        def term(left: Floats, right: Floats, factor: Floats) -> Floats:
            node = np.einsum("ka,lb,kl->klab", left, right, factor, optimize=True)
            half = np.tensordot(self._extract[0], node, axes=(1, 0))
            return np.moveaxis(np.tensordot(self._extract[1], half, axes=(1, 1)), 0, 1)

        x = term(su, vv, dv[0, 1]) - term(vu, sv, du[0, 1])
        y = term(vu, sv, du[0, 0]) - term(su, vv, dv[0, 0])
        return np.stack([x, y], axis=-1).reshape(x.shape[0] * x.shape[1], -1)


def largest_feasible_step(current: Floats, first: Floats, second: Floats) -> float:
    """Return the largest ``a`` for which all ``current + t first + t^2 second`` stay positive on ``0 <= t < a``.

    Parameters
    ----------
    current, first, second : arrays of one shape
        ``current`` must be positive.

    Returns
    -------
    float
        ``inf`` when no coefficient ever reaches zero.

    Examples
    --------
    >>> largest_feasible_step(np.array([1.0, 1.0]), np.array([-0.5, 1.0]), np.array([0.0, 0.0]))
    2.0
    """
    c, b, a = current.ravel(), first.ravel(), second.ravel()
    root = np.full(c.shape, np.inf)
    discriminant = b * b - 4 * a * c
    real = discriminant >= 0
    # the stable form of the smallest positive root: 2c / (-b + sqrt(disc)) for the branch that reaches zero first
    denominator = -b + np.sqrt(np.where(real, discriminant, 0.0))
    hits = real & (denominator > 0)
    root[hits] = 2 * c[hits] / denominator[hits]
    return float(root.min())
