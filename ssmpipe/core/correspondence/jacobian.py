"""The Jacobian determinant of a B-spline reparameterization as a finite list of numbers: Bernstein, B-spline or sampled.

``J = det dD/du`` is a piecewise polynomial of degree ``2p - 1`` per direction (``p - 1`` for curves). Its values at a few
nodes per span determine it, so every form is one linear map of node values: Bernstein coefficients per span (Li 2015, [2.10]
and appendix C), B-spline coefficients on the knots of ``J`` [2.8, 2.9], or the values at the landmarks themselves [2.11]. The
first two bound ``J`` from below over the whole domain; sampling does not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.direction import Direction, apply_directions, components_first
from ssmpipe.core.correspondence.reparameterization import Reparameterization, numbered
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix

JacobianForm = Literal["bezier", "bspline", "sampled"]


def bernstein_matrix(t: Floats, degree: int) -> Floats:
    """Return the (n, degree + 1) Bernstein basis at ``t`` in [0, 1].

    Examples
    --------
    >>> bernstein_matrix(np.array([0.5]), 2)
    array([[0.25, 0.5 , 0.25]])
    """
    k = np.arange(degree + 1)
    return np.asarray(comb(degree, k) * t[:, None] ** k * (1.0 - t[:, None]) ** (degree - k))


def _span_nodes(direction: Direction, degree: int) -> tuple[Floats, Floats]:
    """Return Chebyshev nodes inside every span, (n_spans * (degree + 1),), and their local coordinates."""
    t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    ends = direction.breakpoints
    return (ends[:-1, None] + np.diff(ends)[:, None] * t).ravel(), t


class Jacobian:
    """Coefficients of ``det dD/du`` in one form, for many shapes at once, with their derivatives.

    Parameters
    ----------
    reparameterization : Reparameterization
    form : {"bezier", "bspline", "sampled"}, default="bezier"
        ``sampled`` takes the nodes of the reparameterization.

    Attributes
    ----------
    degree : int
        Polynomial degree of J per direction.
    n : int
        Number of coefficients per shape.

    Raises
    ------
    GeometryError
        For the B-spline form of a periodic map, which is not implemented; its Bernstein form is tighter anyway.

    Notes
    -----
    ``J`` is only ``p - 2`` times continuously differentiable across a knot, so its B-spline form needs ``p + 1`` equal
    interior knots; with p = 2 the two forms hold the same numbers, in the Bernstein form each shared one twice.

    Examples
    --------
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> J = Jacobian(D).coefficients(D.identity()[None])
    >>> J.shape, bool(np.allclose(J, 1))
    ((1, 144), True)
    """

    def __init__(self, reparameterization: Reparameterization, form: JacobianForm = "bezier") -> None:
        self.form = form
        self.n_directions = reparameterization.n_directions
        p = reparameterization.degree
        self.degree = p - 1 if self.n_directions == 1 else 2 * p - 1
        values, slopes, extract = [], [], []
        for axis, direction in enumerate(reparameterization.directions):
            if form == "sampled":
                nodes = reparameterization.nodes[axis]
                extraction = np.eye(len(nodes))
            else:
                nodes, t = _span_nodes(direction, self.degree)
                if form == "bezier":
                    extraction = np.kron(np.eye(direction.n_spans), np.linalg.inv(bernstein_matrix(t, self.degree)))
                else:
                    extraction = self._bspline_extraction(direction, nodes, p)
            values.append(direction.matrix(nodes))
            slopes.append(direction.matrix(nodes, 1))
            extract.append(extraction)
        self.n_spans = tuple(d.n_spans for d in reparameterization.directions)
        self.shape = tuple(e.shape[0] for e in extract)
        self.n = int(np.prod(self.shape))
        self._identity = reparameterization.identity()
        self._extent = reparameterization.window.extent
        self._free = reparameterization.free
        self._extract = tuple(extract)
        self._back = tuple(e.T for e in extract)
        self._mixed = tuple(
            tuple(slopes[k] if k == axis else values[k] for k in range(self.n_directions))
            for axis in range(self.n_directions)
        )

    def _bspline_extraction(self, direction: Direction, nodes: Floats, p: int) -> Floats:
        if direction.periodic:
            raise GeometryError(
                "the B-spline form of the Jacobian is for fixed and sliding boundaries", "use the bezier form"
            )
        multiplicity = 1 if self.n_directions == 1 else p + 1
        inner = np.repeat(direction.breakpoints[1:-1], multiplicity)
        knots = np.concatenate([np.zeros(self.degree + 1), inner, np.ones(self.degree + 1)])
        return np.asarray(np.linalg.pinv(design_matrix(nodes, knots, self.degree)))

    # -- values --------------------------------------------------------------------------------------------------------

    def at(self, coefficients: Floats) -> LocalJacobian:
        """Return the Jacobians of (n_S, *n_b, d_par) coefficients of D, to be differentiated there."""
        gradients = self._gradients(coefficients - self._identity)
        for axis, g in enumerate(gradients):
            g[:, axis] += self._extent[axis]
        return LocalJacobian(self, gradients)

    def _gradients(self, displacement: Floats) -> list[Floats]:
        """Return dD/du_k at the nodes, (n_S, d_par, *nodes) each, without the identity."""
        moved = components_first(displacement)
        return [apply_directions(self._mixed[axis], moved) for axis in range(self.n_directions)]

    def coefficients(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n) coefficients of J from the (n_S, *n_b, d_par) coefficients of D."""
        return self.at(coefficients).values

    def _extracted(self, at_nodes: Floats) -> Floats:
        return apply_directions(self._extract, at_nodes).reshape(len(at_nodes), -1)

    def patches(self, flat: Floats) -> Floats:
        """Reshape (n_S, n) Bernstein coefficients to (n_S, n_cells, m[, m]), ``m = degree + 1``."""
        m = self.degree + 1
        if self.n_directions == 1:
            return flat.reshape(-1, self.n_spans[0], m)
        split = flat.reshape(-1, self.n_spans[0], m, self.n_spans[1], m).transpose(0, 1, 3, 2, 4)
        return split.reshape(len(flat), -1, m, m)

    # -- derivatives ---------------------------------------------------------------------------------------------------

    def pull_back(self, coefficients: Floats, weights: Floats) -> Floats:
        """Return ``sum_z weights_z dJ_z/db``, shape of ``coefficients``; ``weights`` is (n_S, n)."""
        return self.at(coefficients).pull_back(weights)

    def rows(self, coefficients: Floats) -> Floats:
        """Return dJ_z/db of one shape, (n, n_b1 [* n_b2 * 2]), for Gauss-Newton blocks."""
        if self.n_directions == 1:
            return np.asarray(self._extract[0] @ self._mixed[0][0])
        du, dv = self.at(coefficients[None]).gradients
        (su, vv), (vu, sv) = self._mixed

        def term(left: Floats, right: Floats, factor: Floats) -> Floats:
            node = np.einsum("ka,lb,kl->klab", left, right, factor, optimize=True)
            half = np.tensordot(self._extract[0], node, axes=(1, 0))
            return np.moveaxis(np.tensordot(self._extract[1], half, axes=(1, 1)), 0, 1)

        x = term(su, vv, dv[0, 1]) - term(vu, sv, du[0, 1])
        y = term(vu, sv, du[0, 0]) - term(su, vv, dv[0, 0])
        return np.stack([x, y], axis=-1).reshape(self.n, -1)

    def normal_blocks(self, coefficients: Floats, curvature: Floats) -> Floats:
        """Return ``sum_z curvature_z dJ_z/db dJ_z/db^T`` for every shape, (n_S, m, m), in the m free coefficients.

        Parameters
        ----------
        coefficients : (n_S, *n_b, d_par)
        curvature : (n_S, n)
        """
        if self.n_directions == 1 or self.form != "bezier":
            all_rows = [self.rows(c)[:, self._free.ravel()] for c in coefficients]
            return np.stack([r.T @ (k[:, None] * r) for r, k in zip(all_rows, curvature, strict=True)])
        # a Bernstein coefficient depends on the (p + 1)^2 control points of its own span only
        (n0, n1), m = self.n_spans, self.degree + 1
        nodes, extraction, assembly = self._local
        du, dv = self.at(coefficients).gradients

        def cells(field: Floats) -> Floats:
            return field.reshape(-1, n0, m, n1, m).transpose(0, 1, 3, 2, 4)

        x = nodes[0] * cells(dv[:, 1])[..., None] - nodes[1] * cells(du[:, 1])[..., None]
        y = nodes[1] * cells(du[:, 0])[..., None] - nodes[0] * cells(dv[:, 0])[..., None]
        rows = extraction @ np.stack([x, y], axis=-1).reshape(len(x), n0 * n1, m * m, -1)
        weight = cells(curvature).reshape(len(x), n0 * n1, m * m, 1)
        local = np.swapaxes(rows, 2, 3) @ (rows * weight)
        n = int(np.count_nonzero(self._free))
        return np.stack([(assembly @ one.ravel()).reshape(n, n) for one in local])

    @cached_property
    def _local(self) -> tuple[tuple[Floats, Floats], Floats, scipy.sparse.csr_array]:
        """Return, per span, the node derivatives that are not zero, the extraction, and the sum over the spans."""
        m = self.degree + 1
        p = (self.degree + 1) // 2
        local, columns = [], []
        for axis in range(2):
            n = self.n_spans[axis]
            column = (np.arange(n)[:, None] + np.arange(p + 1)) % self._identity.shape[axis]
            pair = [self._mixed[a][axis].reshape(n, m, -1) for a in (0, 1)]
            local.append([np.take_along_axis(b, column[:, None, :], axis=2) for b in pair])
            columns.append(column)
        n0, n1 = self.n_spans
        both = [
            np.asarray(np.einsum("xka,ylb->xyklab", u, v), np.float64).reshape(n0, n1, m, m, (p + 1) ** 2)
            for u, v in zip(local[0], local[1], strict=True)
        ]
        extraction = np.kron(self._extract[0][:m, :m], self._extract[1][:m, :m])
        cell = columns[0][:, None, :, None] * self._identity.shape[1] + columns[1][None, :, None, :]
        place = numbered(self._free)[(cell.reshape(n0 * n1, -1, 1) * 2 + np.arange(2)).reshape(n0 * n1, -1)]
        n = int(np.count_nonzero(self._free))
        target = (place[:, :, None] * n + place[:, None, :]).ravel()
        kept = np.flatnonzero((np.minimum(place[:, :, None], place[:, None, :]) >= 0).ravel())
        ones = (np.ones(len(kept)), (target[kept], kept))
        assembly = scipy.sparse.csr_array(ones, shape=(n * n, len(target)))
        return (both[0], both[1]), np.asarray(extraction, np.float64), assembly


class LocalJacobian:
    """Jacobians at given coefficients of D, with their derivatives there; from :meth:`Jacobian.at`.

    Examples
    --------
    >>> D = Reparameterization((5,), (3,))
    >>> Jacobian(D).at(D.identity()[None]).values
    array([[1., 1., 1., 1., 1., 1.]])
    """

    def __init__(self, jacobian: Jacobian, gradients: list[Floats]) -> None:
        self._of = jacobian
        self.gradients = gradients

    @cached_property
    def values(self) -> Floats:
        """The (n_S, n) coefficients of J."""
        g = self.gradients
        if len(g) == 1:
            return self._of._extracted(g[0][:, 0])
        return self._of._extracted(g[0][:, 0] * g[1][:, 1] - g[0][:, 1] * g[1][:, 0])

    def part(self, block: slice) -> LocalJacobian:
        """Return the same for some shapes."""
        return LocalJacobian(self._of, [g[block] for g in self.gradients])

    def along(self, direction: Floats) -> tuple[Floats, Floats]:
        """Return ``J1, J2`` with ``J(b + a d) = J(b) + a J1 + a^2 J2`` exactly."""
        g, h = self.gradients, self._of._gradients(direction)
        if len(g) == 1:
            first = self._of._extracted(h[0][:, 0])
            return first, np.zeros_like(first)
        return self._first(h), self._of._extracted(h[0][:, 0] * h[1][:, 1] - h[0][:, 1] * h[1][:, 0])

    def _first(self, h: list[Floats]) -> Floats:
        (du, dv), (eu, ev) = self.gradients, h
        return self._of._extracted(
            du[:, 0] * ev[:, 1] + eu[:, 0] * dv[:, 1] - du[:, 1] * ev[:, 0] - eu[:, 1] * dv[:, 0]
        )

    def pull_back(self, weights: Floats) -> Floats:
        """Return ``sum_z weights_z dJ_z/db``, (n_S, *n_b, d_par); ``weights`` is (n_S, n)."""
        back = self._back(weights)
        if len(self.gradients) == 1:
            return (back @ self._of._mixed[0][0])[..., None]
        return self._pulled(*(back[:, None] * g for g in self.gradients))

    def pull_back_along(self, direction: Floats, slope_along: Callable[[Floats], Floats], weights: Floats) -> Floats:
        """Return the change of :meth:`pull_back` of some weights along a direction.

        Parameters
        ----------
        direction : (n_S, *n_b, d_par)
        slope_along : callable
            Change of J along the direction, (n_S, n), to the change of the weights.
        weights : (n_S, n)
            As they are here.
        """
        h = self._of._gradients(direction)
        if len(h) == 1:
            return self.pull_back(slope_along(self._of._extracted(h[0][:, 0])))
        change, back = self._back(slope_along(self._first(h))), self._back(weights)
        return self._pulled(*(change[:, None] * g + back[:, None] * e for g, e in zip(self.gradients, h, strict=True)))

    def _back(self, weights: Floats) -> Floats:
        return apply_directions(self._of._back, weights.reshape(-1, *self._of.shape))

    def _pulled(self, along_u: Floats, along_v: Floats) -> Floats:
        """Return the derivative of ``sum du_0 dv_1 - du_1 dv_0`` with one factor of each product held: weighted (n_S, 2, *nodes)."""
        (su, vv), (vu, sv) = self._of._mixed
        total = su.T @ along_v @ vv - vu.T @ along_u @ sv
        return np.stack([total[:, 1], -total[:, 0]], axis=-1)


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
