"""Affine normalization of corresponded point sets."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def affine_to_mean(
    points: Floats, weights: Floats, *, n_iterations: int = 5, ridge: float = 1e-3
) -> tuple[Floats, Floats]:
    """Return the linear maps that bring corresponded shapes closest to their common mean.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    weights : (n_P,) float64
        Sum 1.
    n_iterations : int, default=5
    ridge : float, default=1e-3
        Pull towards the identity, relative to the variance; keeps flat shapes from being stretched along their normal.

    Returns
    -------
    linear : (n_S, d, d) float64
        Their mean is the identity, so that the cohort neither shrinks nor shears as a whole.
    offset : (n_S, d) float64
        ``x -> linear x + offset`` brings every centroid to the common centroid.

    Examples
    --------
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> linear, _ = affine_to_mean(np.stack([square * [1, 1], square * [2, 1]]), np.full(4, 0.25))
    >>> bool(linear[0, 0, 0] > 1.2 and linear[1, 0, 0] < 0.8)
    True
    """
    n_shapes, _, d = points.shape
    centroids = np.einsum("l,ild->id", weights, points)
    centred = points - centroids[:, None]
    covariance = np.einsum("l,ila,ilb->iab", weights, centred, centred)
    pull = ridge * np.trace(covariance, axis1=1, axis2=2)[:, None, None] / d * np.eye(d)
    linear = np.repeat(np.eye(d)[None], n_shapes, axis=0)
    for _ in range(n_iterations):
        mean = np.einsum("iab,ilb->la", linear, centred) / n_shapes
        cross = np.einsum("l,ila,lb->iab", weights, centred, mean)
        linear = np.swapaxes(np.linalg.solve(covariance + pull, cross + pull), 1, 2)
        linear = np.linalg.inv(linear.mean(axis=0)) @ linear
    offset = centroids.mean(axis=0) - np.einsum("iab,ib->ia", linear, centroids)
    return linear, offset
