"""The result of the group optimization."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ssmpipe.core.align.procrustes import Alignment
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.certificate import Certificate
from ssmpipe.core.correspondence.window import Window


@dataclass(frozen=True, eq=False)
class Optimum:
    """Result of the group optimization.

    Parameters
    ----------
    coefficients : (n_S, *n_b, d_par)
    parameters : (n_S, n_P, d_par)
        ``D_i(u_l)`` on the landmark grid.
    points, initial_points : (n_S, n_P, d)
        In the refined pose [mm], sizes kept.
    alignment : Alignment
        From the input frame to the refined pose.
    eigenvalues, eigenvalues_initial : (n_S - 1,)
        Inside the objective [mm^2], normals included, both in the refined pose.
    description_length : (before, after)
        Of the same.
    lambda_cut : float
    reference : int
        -1 when all shapes move.
    certificates : tuple of Certificate
    guide_residuals : (n_S, n_K)
        Distance on the surface between a guide and where it is carried [mm]; NaN where a shape lacks it.
    window : Window or None
        What the model covers of the registered reference where rims are free.
    lacking : tuple of int
        Shapes that end before the window does.
    rim_shifts : (n_S,) or empty
        By how much rims lie elsewhere than those of the reference [share of the parameter]; empty where it was not asked for.
    normals : (n_S, n_P, d), or None where they have no weight
        Unit normals in the refined pose.
    normal_scale : float
        What they were multiplied with [mm].
    evaluator : {"numpy", "numba"}
        Which one evaluated the splines; both give the same bits.
    """

    coefficients: Floats
    parameters: Floats
    points: Floats
    initial_points: Floats
    alignment: Alignment
    eigenvalues: Floats
    eigenvalues_initial: Floats
    description_length: tuple[float, float]
    lambda_cut: float
    reference: int
    certificates: tuple[Certificate, ...]
    guide_residuals: Floats = field(default_factory=lambda: np.empty((0, 0)))
    window: Window | None = None
    lacking: tuple[int, ...] = ()
    rim_shifts: Floats = field(default_factory=lambda: np.empty(0))
    normals: Floats | None = None
    normal_scale: float = 0.0
    evaluator: str = "numpy"
