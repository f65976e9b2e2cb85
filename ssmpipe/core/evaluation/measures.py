"""Compactness, generalization and specificity of a model (Styner et al. 2003; Li 2015, [2.25-2.27])."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.model.pca import principal_components


def compactness(variances: Floats, n_shapes: int) -> tuple[Floats, Floats]:
    """Return the cumulative variance ratio for 1, 2, ... modes and the compactness error [2.27].

    Parameters
    ----------
    variances : (n_modes,) float64
        Decreasing [mm^2].
    n_shapes : int

    Returns
    -------
    ratio : (n_modes,) float64
    error : (n_modes,) float64
        ``sum_m sqrt(2 / n_S) lambda_m``, in the unit of the variances [mm^2].

    Examples
    --------
    >>> compactness(np.array([3.0, 1.0]), 8)
    (array([0.75, 1.  ]), array([1.5, 2. ]))
    """
    cumulative = np.cumsum(variances)
    return cumulative / cumulative[-1], np.sqrt(2.0 / n_shapes) * cumulative


def generalization(points: Floats, max_modes: int) -> tuple[Floats, Floats]:
    """Return the leave-one-out reconstruction error for 1, 2, ... modes.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        At least three shapes [mm].
    max_modes : int
        At most ``n_S - 2``.

    Returns
    -------
    mean, standard_error : (max_modes,) float64
        Root mean square distance per point [mm], over the left-out shapes; error as in [2.26].

    Notes
    -----
    Needs one ``n_S x n_S`` Gram matrix only: every leave-one-out model lives in the span of the cohort.
    """
    n_shapes, n_points = points.shape[:2]
    flat = points.reshape(n_shapes, -1)
    flat = flat - flat.mean(axis=0)
    gram = flat @ flat.T
    errors = np.empty((n_shapes, max_modes))
    for left_out in range(n_shapes):
        others = np.delete(np.arange(n_shapes), left_out)
        inner = gram[np.ix_(others, others)]
        row = inner.mean(axis=0)
        centred = inner - row[:, None] - row[None, :] + row.mean()
        values, vectors = np.linalg.eigh(centred)
        values, vectors = values[::-1][:max_modes], vectors[:, ::-1][:, :max_modes]
        cross = gram[left_out, others]
        against_mean = cross - cross.mean() - row + row.mean()
        square = gram[left_out, left_out] - 2 * cross.mean() + row.mean()
        coordinates = np.where(
            values > 1e-12 * values[0], vectors.T @ against_mean / np.sqrt(np.maximum(values, 1e-300)), 0.0
        )
        errors[left_out] = np.sqrt(np.maximum(square - np.cumsum(coordinates**2), 0.0) / n_points)
    return errors.mean(axis=0), errors.std(axis=0, ddof=1) / np.sqrt(n_shapes - 1)


def specificity(points: Floats, max_modes: int, *, n_samples: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the distance of random model instances to the nearest shape of the cohort for 1, 2, ... modes.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    max_modes : int
    n_samples : int
        Instances drawn from the normal distribution of the model; the same draws serve all numbers of modes.
    rng : numpy.random.Generator

    Returns
    -------
    mean, standard_error : (max_modes,) float64
        Root mean square distance per point [mm].
    """
    n_points = points.shape[1]
    _, _, variances, scores = principal_components(points)
    max_modes = min(max_modes, len(variances))
    sigma = np.sqrt(variances)
    draws = rng.standard_normal((n_samples, len(variances))) * sigma
    shapes = scores * sigma
    # modes are orthonormal and span the cohort: distances in mode coordinates are distances of the shape vectors
    mean = np.empty(max_modes)
    error = np.empty(max_modes)
    for m in range(1, max_modes + 1):
        inside = ((draws[:, None, :m] - shapes[None, :, :m]) ** 2).sum(-1)
        outside = (shapes[:, m:] ** 2).sum(-1)
        nearest = np.sqrt((inside + outside).min(axis=1) / n_points)
        mean[m - 1] = nearest.mean()
        error[m - 1] = nearest.std(ddof=1) / np.sqrt(n_samples - 1)
    return mean, error
