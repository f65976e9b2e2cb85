"""The nearest place on a spline."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.evaluate import Spline, SplineStack


def nearest_parameters(
    spline: Spline, points: Floats, *, n_start: int = 201, n_iterations: int = 20
) -> tuple[Floats, Floats]:
    """Return the parameters of the nearest places on a spline, and the distances.

    Parameters
    ----------
    spline : BSplineCurve or BSplineSurface
    points : (n, d) float64
    n_start : int, default=201
        Samples per direction for the start; Gauss-Newton steps that never increase the distance follow.
    n_iterations : int, default=20

    Returns
    -------
    parameters : (n, d_par) float64
    distances : (n,) float64

    Examples
    --------
    >>> from ssmpipe.core.spline.curve import BSplineCurve
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0.0, 0], [2, 0]]))
    >>> nearest_parameters(line, np.array([[0.5, 1.0]]))
    (array([[0.25]]), array([1.]))
    """
    n_d = len(spline.degrees)
    stack = SplineStack([spline])
    axes = [np.linspace(0.0, 1.0, n_start)] * n_d
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n_d)
    start = cKDTree(stack.evaluate(nodes[None]).points[0]).query(points)[1]
    parameters = nodes[start]
    jet = stack.evaluate(parameters[None])
    distance = np.linalg.norm(jet.points[0] - points, axis=1)
    for _ in range(n_iterations):
        residual = points - jet.points[0]
        tangents = np.stack([f[0] for f in jet.first], axis=1)
        normal = np.einsum("nad,nbd->nab", tangents, tangents)
        normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(n_d)
        step = np.linalg.solve(normal, np.einsum("nad,nd->na", tangents, residual)[..., None])[..., 0]
        trial = np.clip(parameters + step, 0.0, 1.0)
        trial_jet = stack.evaluate(trial[None])
        trial_distance = np.linalg.norm(trial_jet.points[0] - points, axis=1)
        better = trial_distance < distance
        if not better.any():
            break
        parameters = np.where(better[:, None], trial, parameters)
        jet = stack.evaluate(parameters[None])
        distance = np.minimum(distance, trial_distance)
    return parameters, distance
