"""Every shape of a cohort rebuilt from the others."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def leave_one_out_reconstructions(points: Floats, n_modes: int | None = None) -> Floats:
    """Return every shape as the model of the other shapes reproduces it.

    The model of the others (mean and principal components) is fitted to the left-out shape in the least-squares sense, point by
    point (Styner et al. 2003, generalization ability, before the distance is taken).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        Corresponded points of at least two shapes [mm].
    n_modes : int, optional
        Leading modes of the model of the others; all of them (at most ``n_S - 2``) when absent.

    Returns
    -------
    (n_S, n_P, d) float64

    Examples
    --------
    Three shapes on a line: the one in the middle is within the span of the others, whatever its distance to them.

    >>> shapes = np.array([[[0.0, 0]], [[1, 2]], [[3, 6]]])
    >>> leave_one_out_reconstructions(shapes).round(9)[1] + 0.0
    array([[1., 2.]])
    """
    n_shapes = len(points)
    flat = points.reshape(n_shapes, -1)
    made = np.empty_like(flat)
    for left_out in range(n_shapes):
        others = np.delete(flat, left_out, axis=0)
        mean = others.mean(axis=0)
        centred = others - mean
        # by the small Gram matrix: the same bits for any number of threads
        values, vectors = np.linalg.eigh(centred @ centred.T)
        values, vectors = values[::-1], vectors[:, ::-1]
        keep = values > 1e-12 * max(values[0], 0.0)
        keep[n_shapes - 2 if n_modes is None else n_modes :] = False
        against = centred @ (flat[left_out] - mean)
        weights = vectors[:, keep] @ ((vectors[:, keep].T @ against) / values[keep])
        made[left_out] = mean + weights @ centred
    return made.reshape(points.shape)
