"""The objective of the group optimization: a spectral function, a smoothness prior, guides and a barrier, with gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from ssmpipe.core.align.differentiable import align_to, align_to_adjoint
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.covariance import Spectrum, spectral_adjoint, spectrum
from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.jacobian import Jacobian, JacobianForm, largest_feasible_step
from ssmpipe.core.correspondence.prior import bending_matrix
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.spectral import SpectralFunction
from ssmpipe.core.covariance.formulation_two import size_weights, size_weights_adjoint
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import Jet, SplineStack

Covariance = Literal["discrete", "I", "II"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one evaluation of the cohort knows: kept for the gradient, the preconditioner and the records."""

    jet: Jet
    points: Floats
    rotations: Floats
    slopes: tuple[Floats, ...]
    weights: Floats
    mean_tangents: tuple[Floats, ...]
    spectrum: Spectrum


class GroupObjective:
    """``f(b) = sum phi(lambda_m) + prior + guides + mu * barrier`` over all moving shapes.

    Parameters
    ----------
    stack : SplineStack
        The cohort's splines, posed (and scaled) as the objective shall see them.
    reparameterization : Reparameterization
        Its nodes are the landmarks of the covariance.
    spectral : SpectralFunction
    base_weights : (n_P,) float64, optional
        Quadrature weights of the nodes; equal by default.
    covariance : {"discrete", "I", "II"}, default="discrete"
        ``discrete`` and ``I`` use the base weights; ``II`` multiplies them by the size element of the mean shape, and the
        gradient holds the derivative of these weights.
    prior : float, default=0
        Weight of the bending energy of every ``D_i`` [nat].
    barrier : float, default=1
        Weight ``mu`` of the barrier [nat].
    constraint : Barrier, optional
    form : {"bezier", "bspline", "sampled"}, default="bezier"
        Form of the Jacobian that the barrier sees.
    guides : Guides, optional
        Named landmarks that pull.
    reference : int, default=-1
        Shape whose ``D`` stays the identity; with -1 all shapes move and the mean of all displacements stays zero.
    other_gradient : callable, optional
        ``(objective, x) -> gradient`` of the spectral part in place of the adjoint, for comparison.
    target : (n_P, d) float64, optional
        When given, every shape's landmarks are moved rigidly to this target inside each evaluation, and the gradient
        contains the derivative of these motions.

    Raises
    ------
    GeometryError
        For a target with formulation II, which is not implemented.

    Notes
    -----
    One spline evaluation gives value and gradient. Cost: one pass over the landmarks, two products of size
    ``n_S x n_S x 3 n_P`` and one ``n_S^3`` eigendecomposition.
    """

    def __init__(
        self,
        stack: SplineStack,
        reparameterization: Reparameterization,
        spectral: SpectralFunction,
        *,
        base_weights: Floats | None = None,
        covariance: Covariance = "discrete",
        prior: float = 0.0,
        barrier: float = 1.0,
        constraint: Barrier | None = None,
        form: JacobianForm = "bezier",
        guides: Guides | None = None,
        reference: int = -1,
        other_gradient: Callable[[GroupObjective, Floats], Floats] | None = None,
        target: Floats | None = None,
    ) -> None:
        self.stack = stack
        self.reparameterization = reparameterization
        self.spectral = spectral
        self.covariance = covariance
        self.prior = prior
        self.barrier = barrier
        self.constraint = constraint or Barrier()
        self.guides = guides
        self.reference = reference
        self.other_gradient = other_gradient
        self.target = target
        if target is not None and covariance == "II":
            raise GeometryError(
                "aligning inside each evaluation is implemented for covariance discrete and I", "use pose: refined"
            )
        self.moving = np.array([i for i in range(stack.n_shapes) if i != reference])
        self.jacobian = Jacobian(reparameterization, form)
        n_p = int(np.prod(reparameterization.grid))
        self._base = np.full(n_p, 1.0 / n_p) if base_weights is None else base_weights
        self._bending = bending_matrix(reparameterization)
        self._free = reparameterization.free
        self._identity = reparameterization.identity()
        self._last: tuple[bytes, Evaluation] | None = None

    # -- unknowns ------------------------------------------------------------------------------------------------------

    def start(self) -> Floats:
        """Return the unknowns of the identity."""
        return np.tile(self._identity[self._free], len(self.moving))

    def unknowns(self, coefficients: Floats) -> Floats:
        """Return the unknowns of (n_S, *n_b, d_par) coefficients."""
        return coefficients[self.moving][:, self._free].ravel()

    def coefficients(self, x: Floats) -> Floats:
        """Return the (n_S, *n_b, d_par) coefficients of all shapes."""
        out = np.repeat(self._identity[None], self.stack.n_shapes, axis=0)
        moving = out[self.moving]
        moving[:, self._free] = x.reshape(len(self.moving), -1)
        out[self.moving] = moving
        return out

    def _direction(self, direction: Floats) -> Floats:
        out = np.zeros((len(self.moving), *self._identity.shape))
        out[:, self._free] = direction.reshape(len(self.moving), -1)
        return out

    def _keep_gauge(self, vector: Floats) -> Floats:
        """Remove the mean over the shapes when all of them move."""
        if self.reference >= 0:
            return vector
        rows = vector.reshape(len(self.moving), -1)
        return (rows - rows.mean(axis=0)).ravel()

    # -- value and gradient --------------------------------------------------------------------------------------------

    def evaluate(self, x: Floats) -> Evaluation:
        """Evaluate the cohort at ``x``; the last evaluation is remembered."""
        key = x.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        coefficients = self.coefficients(x)
        parameters = self.reparameterization.evaluate(coefficients)
        second = self.covariance == "II"
        jet = self.stack.evaluate(parameters, second=second)
        slopes: tuple[Floats, ...] = ()
        tangents: tuple[Floats, ...] = ()
        weights = self._base
        if second:
            slopes = self.reparameterization.slopes(coefficients)
            tangents = tuple(
                sum(np.einsum("ild,il->ld", jet.first[c], slope[..., c]) for c in range(len(jet.first)))
                / self.stack.n_shapes
                for slope in slopes
            )
            weights = size_weights(self._base, tangents)
        points, rotations = jet.points, np.empty(0)
        if self.target is not None:
            aligned = [align_to(p, self.target, weights) for p in jet.points]
            points, rotations = np.stack([a[0] for a in aligned]), np.stack([a[1] for a in aligned])
        spec = spectrum(points - points.mean(axis=0), weights)
        evaluation = Evaluation(jet, points, rotations, slopes, weights, tangents, spec)
        self._last = (key, evaluation)
        return evaluation

    def spectral_value(self, x: Floats) -> float:
        """Return the spectral function alone."""
        return self.spectral.value(self.evaluate(x).spectrum.eigenvalues)

    def smallest_jacobian(self, x: Floats) -> float:
        """Return the smallest coefficient of all Jacobians; in the Bernstein form a lower bound of ``det dD/du``."""
        return float(self.jacobian.coefficients(self.coefficients(x)[self.moving]).min())

    def spectral_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return the spectral function and its gradient in the unknowns, by the adjoint [2.20]."""
        evaluation = self.evaluate(x)
        jet = evaluation.jet
        centred = evaluation.points - evaluation.points.mean(axis=0)
        d_points, d_weights, _ = spectral_adjoint(centred, evaluation.weights, evaluation.spectrum, self.spectral.slope)
        if self.target is not None:
            per_shape = zip(jet.points, evaluation.rotations, d_points, strict=True)
            d_points = np.stack([align_to_adjoint(p, self.target, evaluation.weights, r, d) for p, r, d in per_shape])
        d_parameters = np.stack([np.einsum("ild,ild->il", d_points, s) for s in jet.first], axis=-1)
        d_slopes: tuple[Floats, ...] = ()
        if self.covariance == "II":
            d_tangents = size_weights_adjoint(self._base, evaluation.mean_tangents, d_weights)
            d_parameters = d_parameters + self._through_tangents(evaluation, d_tangents)
            d_slopes = tuple(
                np.stack([np.einsum("ld,ild->il", d, s) for s in jet.first], axis=-1) / self.stack.n_shapes
                for d in d_tangents
            )
        moving = self.moving
        pulled = self.reparameterization.pull_back(d_parameters[moving], tuple(d[moving] for d in d_slopes))
        return self.spectral.value(evaluation.spectrum.eigenvalues), pulled[:, self._free].ravel()

    def _through_tangents(self, evaluation: Evaluation, d_tangents: tuple[Floats, ...]) -> Floats:
        """Return df/dD through ``dx/du_k = sum_c S_c(D) dD^c/du_k``: second derivatives of the splines."""
        n = len(evaluation.jet.first)
        out = np.zeros((*evaluation.jet.points.shape[:2], n))
        for d_tangent, slope in zip(d_tangents, evaluation.slopes, strict=True):
            for c in range(n):
                for e in range(n):
                    out[..., c] += np.einsum("ld,ild->il", d_tangent, evaluation.jet.second[c + e]) * slope[..., e]
        return out / self.stack.n_shapes

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return ``f`` and its gradient; infinite outside the feasible set."""
        moving = self.coefficients(x)[self.moving]
        jacobians = self.jacobian.coefficients(moving)
        penalty = self.constraint.value(jacobians) if self.barrier > 0 else 0.0
        if not np.isfinite(penalty):
            return np.inf, np.zeros_like(x)
        if self.other_gradient is None:
            value, gradient = self.spectral_gradient(x)
        else:
            value, gradient = self.spectral_value(x), self.other_gradient(self, x)
        extra = np.zeros_like(moving)
        if self.barrier > 0:
            value += self.barrier * penalty
            extra += self.barrier * self.jacobian.pull_back(moving, self.constraint.slope(jacobians))
        if self.prior > 0:
            displacement = moving - self._identity
            bent = self._bent(displacement)
            value += 0.5 * self.prior * float((bent * displacement).sum())
            extra += self.prior * bent
        if self.guides is not None:
            pull, d_pull = self.guides.value_and_gradient(self.coefficients(x))
            value += pull
            extra += d_pull[self.moving]
        return value, self._keep_gauge(gradient + extra[:, self._free].ravel())

    def _bent(self, displacement: Floats) -> Floats:
        flat = displacement.reshape(len(displacement), -1, displacement.shape[-1])
        return (self._bending @ flat).reshape(displacement.shape)

    # -- feasibility and curvature -------------------------------------------------------------------------------------

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return how far ``direction`` can be followed before a coefficient of a Jacobian meets the floor; exact."""
        moving = self.coefficients(x)[self.moving]
        current = self.jacobian.coefficients(moving)
        first, second = self.jacobian.along(moving, self._direction(direction), current)
        return largest_feasible_step(current - self.constraint.floor, first, second)

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the inverse of the block-diagonal Gauss-Newton matrix, one Cholesky factor per shape."""
        evaluation = self.evaluate(x)
        coefficients = self.coefficients(x)
        n_shapes = len(coefficients)
        n_d = self.reparameterization.n_directions
        free = self._free.ravel()
        spec = evaluation.spectrum
        share = ((spec.vectors**2) * self.spectral.slope(spec.eigenvalues)).sum(axis=1) * 2.0 / (n_shapes - 1)
        bending = self.prior * np.kron(self._bending, np.eye(n_d))
        factors = []
        for i in self.moving:
            tangents = np.stack([s[i] for s in evaluation.jet.first], axis=1)
            metric = np.einsum("lad,lbd->lab", tangents, tangents) * (share[i] * evaluation.weights)[:, None, None]
            block = self.reparameterization.normal_blocks(metric) + bending
            if self.barrier > 0:
                rows = self.jacobian.rows(coefficients[i])
                curvature = self.constraint.curvature(self.jacobian.coefficients(coefficients[i][None]))[0]
                block += self.barrier * (rows.T @ (curvature[:, None] * rows))
            if self.guides is not None:
                block += self.guides.hessian(i)
            block = block[np.ix_(free, free)]
            block[np.diag_indices_from(block)] += 1e-8 * np.trace(block) / len(block)
            factors.append(scipy.linalg.cho_factor(block, lower=True, check_finite=False))

        def apply(vector: Floats) -> Floats:
            rows = vector.reshape(len(factors), -1)
            solved = [scipy.linalg.cho_solve(f, r, check_finite=False) for f, r in zip(factors, rows, strict=True)]
            return self._keep_gauge(np.concatenate(solved))

        return apply
