"""The objective of the group optimization: description length, smoothness prior and barrier, with gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.covariance import Spectrum, spectral_adjoint, spectrum
from ssmpipe.core.correspondence.description_length import description_length, description_length_slope
from ssmpipe.core.correspondence.jacobian import BezierJacobian, largest_feasible_step
from ssmpipe.core.correspondence.prior import thin_plate_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.weights import MeanAreaWeights
from ssmpipe.core.spline.evaluate import SplineStack

Covariance = Literal["discrete", "II"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one evaluation of the cohort knows: kept for the preconditioner and the records."""

    points: Floats
    derivative_u: Floats
    derivative_v: Floats
    weights: Floats
    spectrum: Spectrum
    d_gram: Floats


class GroupObjective:
    """``f(b) = description length + prior - mu * mean log(J - floor)`` over all moving shapes.

    Parameters
    ----------
    stack : SplineStack
        The cohort's surfaces, posed (and scaled) as the objective shall see them.
    reparameterization : Reparameterization
    lambda_cut : float
        Of the description length [mm^2].
    covariance : {"discrete", "II"}, default="discrete"
        Equal weights, or area weights of the mean shape with their exact derivative.
    prior : float, default=0
        Weight of the thin-plate energy of every ``D_i`` [nat].
    barrier : float, default=1
        Weight ``mu`` of the logarithmic barrier on the Bernstein coefficients of every Jacobian [nat].
    floor : float, default=0
        The barrier keeps every Bernstein coefficient above it.
    reference : int, default=-1
        Shape whose ``D`` stays the identity; -1 lets all move.

    Notes
    -----
    One spline evaluation gives value and gradient. Cost: one pass over the landmarks, two products of size
    ``n_S x n_S x 3 n_P`` and one ``n_S^3`` eigendecomposition.
    """

    def __init__(
        self,
        stack: SplineStack,
        reparameterization: Reparameterization,
        *,
        lambda_cut: float,
        covariance: Covariance = "discrete",
        prior: float = 0.0,
        barrier: float = 1.0,
        floor: float = 0.0,
        reference: int = -1,
    ) -> None:
        self.stack = stack
        self.reparameterization = reparameterization
        self.lambda_cut = lambda_cut
        self.prior = prior
        self.barrier = barrier
        self.floor = floor
        self.moving = np.array([i for i in range(stack.n_shapes) if i != reference])
        self.jacobian = BezierJacobian(reparameterization.knots, reparameterization.degree)
        self._weights = MeanAreaWeights(reparameterization.grid) if covariance == "II" else None
        self._plate = thin_plate_matrix(reparameterization)
        self._free = reparameterization.free
        self._identity = reparameterization.identity()
        n_p = int(np.prod(reparameterization.grid))
        self._uniform = np.full(n_p, 1.0 / n_p)
        self._last: tuple[bytes, Evaluation] | None = None

    # -- unknowns ------------------------------------------------------------------------------------------------------

    def start(self) -> Floats:
        """Return the unknowns of the identity."""
        return np.tile(self._identity[self._free], len(self.moving))

    def coefficients(self, x: Floats) -> Floats:
        """Return the (n_S, n_b1, n_b2, 2) coefficients of all shapes."""
        out = np.repeat(self._identity[None], self.stack.n_shapes, axis=0)
        moving = out[self.moving]
        moving[:, self._free] = x.reshape(len(self.moving), -1)
        out[self.moving] = moving
        return out

    def _direction(self, direction: Floats) -> Floats:
        out = np.zeros((len(self.moving), *self._identity.shape))
        out[:, self._free] = direction.reshape(len(self.moving), -1)
        return out

    # -- value and gradient --------------------------------------------------------------------------------------------

    def evaluate(self, x: Floats) -> tuple[Evaluation, Floats]:
        """Evaluate the cohort at ``x``; also return the coefficients."""
        coefficients = self.coefficients(x)
        key = x.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1], coefficients
        jet = self.stack.evaluate(self.reparameterization.evaluate(coefficients))
        points = jet.points
        mean = points.mean(axis=0)
        weights = self._uniform if self._weights is None else self._weights.value(mean)
        spec = spectrum(points - mean, weights)
        d_gram = (spec.vectors * self._slope(spec.eigenvalues)) @ spec.vectors.T
        evaluation = Evaluation(points, *jet.first, weights, spec, d_gram)
        self._last = (key, evaluation)
        return evaluation, coefficients

    def _slope(self, eigenvalues: Floats) -> Floats:
        return description_length_slope(eigenvalues, self.lambda_cut)

    def description_length(self, x: Floats) -> float:
        """Return the description length alone [nat]."""
        return description_length(self.evaluate(x)[0].spectrum.eigenvalues, self.lambda_cut)

    def smallest_jacobian(self, x: Floats) -> float:
        """Return the smallest Bernstein coefficient of all Jacobians: a lower bound of ``det dD/du``."""
        return float(self.jacobian.coefficients(self.coefficients(x)[self.moving]).min())

    def description_length_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return the description length and its gradient in the unknowns."""
        evaluation, _ = self.evaluate(x)
        points = evaluation.points
        centred = points - points.mean(axis=0)
        d_points, d_weights, _ = spectral_adjoint(centred, evaluation.weights, evaluation.spectrum, self._slope)
        if self._weights is not None:
            d_points = d_points + self._weights.pull_back(points.mean(axis=0), d_weights) / len(points)
        d_parameters = np.stack(
            [
                np.einsum("ild,ild->il", d_points, evaluation.derivative_u),
                np.einsum("ild,ild->il", d_points, evaluation.derivative_v),
            ],
            axis=-1,
        )
        pulled = self.reparameterization.pull_back(d_parameters[self.moving])
        return description_length(evaluation.spectrum.eigenvalues, self.lambda_cut), pulled[:, self._free].ravel()

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return ``f`` and its gradient at a feasible ``x``."""
        value, gradient = self.description_length_gradient(x)
        moving = self.coefficients(x)[self.moving]
        extra = np.zeros_like(moving)
        if self.prior > 0:
            plate = self._plate_product(moving)
            value += 0.5 * self.prior * float((plate * moving).sum())
            extra += self.prior * plate
        if self.barrier > 0:
            slack = self.jacobian.coefficients(moving) - self.floor
            n_z = slack.shape[1]
            value -= self.barrier / n_z * float(np.log(slack).sum())
            extra -= self.jacobian.pull_back(moving, self.barrier / n_z / slack)
        return value, gradient + extra[:, self._free].ravel()

    def _plate_product(self, moving: Floats) -> Floats:
        flat = moving.reshape(len(moving), -1, 2)
        return (self._plate @ flat).reshape(moving.shape)

    # -- feasibility and curvature -------------------------------------------------------------------------------------

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return how far ``direction`` can be followed before a Bernstein coefficient meets the floor; exact."""
        moving = self.coefficients(x)[self.moving]
        current = self.jacobian.coefficients(moving)
        first, second = self.jacobian.along(moving, self._direction(direction), current)
        return largest_feasible_step(current - self.floor, first, second)

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the inverse of the block-diagonal Gauss-Newton matrix, one Cholesky factor per shape."""
        evaluation, coefficients = self.evaluate(x)
        n_shapes = len(coefficients)
        free = self._free.ravel()
        factors = []
        plate = self.prior * np.kron(self._plate, np.eye(2))
        for i in self.moving:
            scale = 2.0 / (n_shapes - 1) * evaluation.d_gram[i, i] * evaluation.weights
            du, dv = evaluation.derivative_u[i], evaluation.derivative_v[i]
            metric = np.stack([(du * du).sum(1), (du * dv).sum(1), (dv * dv).sum(1)], axis=1) * scale[:, None]
            block = self.reparameterization.normal_blocks(metric) + plate
            if self.barrier > 0:
                rows = self.jacobian.rows(coefficients[i])
                slack = self.jacobian.coefficients(coefficients[i][None])[0] - self.floor
                rows = rows / slack[:, None]
                block += self.barrier / len(slack) * (rows.T @ rows)
            block = block[np.ix_(free, free)]
            block[np.diag_indices_from(block)] += 1e-8 * np.trace(block) / len(block)
            factors.append(scipy.linalg.cho_factor(block, lower=True, check_finite=False))

        def apply(vector: Floats) -> Floats:
            rows = vector.reshape(len(factors), -1)
            return np.concatenate(
                [scipy.linalg.cho_solve(f, r, check_finite=False) for f, r in zip(factors, rows, strict=True)]
            )

        return apply
