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
    centroids = weights @ points
    centred = points - centroids[:, None]
    covariance = np.swapaxes(centred, 1, 2) @ (weights[:, None] * centred)
    # all shapes in one matrix: two products per iteration
    beside = centred.transpose(1, 0, 2).reshape(-1, n_shapes * d)
    pull = ridge * np.trace(covariance, axis1=1, axis2=2)[:, None, None] / d * np.eye(d)
    linear = np.repeat(np.eye(d)[None], n_shapes, axis=0)
    for _ in range(n_iterations):
        mean = beside @ np.swapaxes(linear, 1, 2).reshape(-1, d) / n_shapes
        cross = (beside.T @ (weights[:, None] * mean)).reshape(n_shapes, d, d)
        linear = np.swapaxes(np.linalg.solve(covariance + pull, cross + pull), 1, 2)
        linear = np.linalg.inv(linear.mean(axis=0)) @ linear
    offset = centroids.mean(axis=0) - np.einsum("iab,ib->ia", linear, centroids)
    return linear, offset


def affine_to_cohort(
    shape: Floats, cohort: Floats, normalized: Floats, weights: Floats, *, ridge: float = 1e-3
) -> tuple[Floats, Floats]:
    """Return the linear map that normalizes one more shape as :func:`affine_to_mean` normalized a cohort, which stays as it is.

    Parameters
    ----------
    shape : (n_P, d) float64
    cohort, normalized : (n_S, n_P, d) float64
        Before and after.
    weights : (n_P,) float64
        Sum 1.
    ridge : float, default=1e-3

    Returns
    -------
    linear : (d, d), offset : (d,) float64

    Examples
    --------
    >>> shapes = np.random.default_rng(0).normal(size=(4, 1, 1)) * 0.1 + np.random.default_rng(1).normal(size=(4, 9, 2))
    >>> weights = np.full(9, 1 / 9)
    >>> linear, offset = affine_to_mean(shapes, weights, n_iterations=200)
    >>> after = shapes @ np.swapaxes(linear, 1, 2) + offset[:, None]
    >>> again, _ = affine_to_cohort(shapes[2], shapes, after, weights)
    >>> bool(np.allclose(again, linear[2], atol=1e-6))
    True
    """
    d = shape.shape[1]
    centroid = weights @ normalized.mean(axis=0)
    mean = normalized.mean(axis=0) - centroid
    own = weights @ cohort
    towards = np.linalg.inv(
        np.stack([_onto(s - c, mean, weights, ridge) for s, c in zip(cohort, own, strict=True)]).mean(axis=0)
    )
    middle = weights @ shape
    linear = towards @ _onto(shape - middle, mean, weights, ridge)
    return linear.reshape(d, d), centroid - linear @ middle


def _onto(centred: Floats, mean: Floats, weights: Floats, ridge: float) -> Floats:
    """Return the linear map of a centred shape to a centred mean."""
    d = centred.shape[1]
    covariance = centred.T @ (weights[:, None] * centred)
    pull = ridge * np.trace(covariance) / d * np.eye(d)
    cross = centred.T @ (weights[:, None] * mean)
    return np.asarray(np.linalg.solve(covariance + pull, cross + pull).T)
