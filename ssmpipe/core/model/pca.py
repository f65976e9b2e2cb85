"""Principal component analysis of corresponded points."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def principal_components(points: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return mean, orthonormal modes, variances and scores of a cohort (Li 2015, [1.19-1.22]).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        At least two shapes.

    Returns
    -------
    mean : (n_P, d)
    modes : (n_modes, n_P, d)
        Orthonormal as vectors; the sign makes the component of largest size positive.
    variances : (n_modes,)
        Decreasing; divisor ``n_S - 1``. ``n_modes`` leaves out directions without variance (rank of the data).
    scores : (n_S, n_modes)
        In units of one standard deviation.

    Notes
    -----
    By the (n_S, n_S) Gram matrix, whose bits do not depend on the number of threads.

    Examples
    --------
    >>> _, _, variances, _ = principal_components(np.array([[[0.0, 0]], [[2.0, 0]]]))
    >>> variances
    array([2.])
    """
    n_shapes = len(points)
    mean = points.mean(axis=0)
    flat = (points - mean).reshape(n_shapes, -1)
    values, vectors = np.linalg.eigh(flat @ flat.T / (n_shapes - 1))
    values, vectors = values[::-1], vectors[:, ::-1]
    keep = np.arange(n_shapes) < n_shapes - 1
    keep &= values > 1e-12 * max(values[0], 0.0)
    variances = values[keep].copy()
    modes = (vectors[:, keep].T @ flat) / np.sqrt((n_shapes - 1) * variances)[:, None]
    largest = np.abs(modes).argmax(axis=1)
    sign = np.sign(modes[np.arange(len(modes)), largest])
    modes *= sign[:, None]
    scores = flat @ modes.T / np.sqrt(variances)
    return mean, modes.reshape(-1, *mean.shape), variances, scores
