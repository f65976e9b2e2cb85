"""Slow gradients of the spectral objective, for comparison: direct differentiation and finite differences."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.errors import GeometryError


def direct_gradient(objective: GroupObjective, x: Floats) -> Floats:
    """Return the gradient by differentiating every eigenvalue in every unknown [2.16].

    For formulations with fixed weights (``discrete``, ``I``). Cost grows with unknowns times shapes times landmarks.

    Raises
    ------
    GeometryError
        For formulation II, whose weights move.
    """
    if objective.covariance == "II" or objective.target is not None:
        raise GeometryError(
            "direct sensitivities are for covariance discrete and I and fixed poses", "sensitivity: adjoint"
        )
    evaluation = objective.evaluate(x)
    jet, spec, weights = evaluation.jet, evaluation.spectrum, evaluation.weights
    n_shapes = len(jet.points)
    weighted = (jet.points - jet.points.mean(axis=0)) * weights[:, None]
    slope = objective.spectral.slope(spec.eigenvalues)
    reparameterization = evaluation.space
    full = np.meshgrid(*reparameterization.nodes, indexing="ij")
    rows = reparameterization.rows_at(np.stack([f.ravel() for f in full], axis=1))
    n_d = reparameterization.n_directions
    gradient = np.zeros((n_shapes, rows.shape[1], n_d))
    for i in objective.moving:
        for component in range(n_d):
            moved = rows[:, :, None] * jet.first[component][i][:, None, :]
            inner = np.einsum("lkd,jld->kj", moved, weighted, optimize=True)
            d_eigenvalues = 2.0 / (n_shapes - 1) * spec.vectors[i] * (inner @ spec.vectors)
            gradient[i, :, component] = d_eigenvalues @ slope
    shaped = gradient.reshape(n_shapes, *reparameterization.n_coefficients, n_d)
    return shaped[objective.moving][:, reparameterization.free].ravel()


def finite_difference_gradient(objective: GroupObjective, x: Floats, step: float = 1e-7) -> Floats:
    """Return the gradient by forward differences: one full evaluation of the cohort per unknown."""
    base = objective.spectral_value(x)
    gradient = np.empty_like(x)
    for k in range(len(x)):
        moved = x.copy()
        moved[k] += step
        gradient[k] = (objective.spectral_value(moved) - base) / step
    return gradient
