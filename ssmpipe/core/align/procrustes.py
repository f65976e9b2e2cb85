"""Procrustes alignment of corresponded point sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats


@dataclass(frozen=True, eq=False)
class Alignment:
    """Rigid motions and size factors that bring a cohort together.

    Parameters
    ----------
    rotation : (n_S, d, d)
        Proper rotations.
    translation : (n_S, d)
        ``x -> R x + t`` moves shape i; its centroid goes to the common centroid.
    scale : (n_S,)
        Factors about the common centroid that give all shapes the mean centroid size; ones when sizes are kept.
    centre : (d,)
        The common centroid.
    """

    rotation: Floats
    translation: Floats
    scale: Floats
    centre: Floats


def rotation_between(source: Floats, target: Floats, weights: Floats) -> Floats:
    """Return the proper rotation that best turns centred ``source`` (n, d) into centred ``target`` (Kabsch 1976).

    Examples
    --------
    >>> quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    >>> bool(np.allclose(rotation_between(np.eye(3), np.eye(3) @ quarter.T, np.ones(3)), quarter))
    True
    """
    return np.asarray(_nearest_rotations((target.T @ (weights[:, None] * source))[None])[0])


def _nearest_rotations(cross: Floats) -> Floats:
    """Return the proper rotations nearest to (n, d, d) matrices."""
    u, _, vt = np.linalg.svd(cross)
    u[:, :, -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return np.asarray(u @ vt)


def generalized_procrustes(
    points: Floats, weights: Floats, *, remove_size: bool, n_iterations: int = 50, tolerance: float = 1e-10
) -> Alignment:
    """Align corresponded shapes to their common mean by rigid motions, and find their size factors (Gower 1975).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    weights : (n_P,) float64
        Sum 1; area weights make the result independent of the landmark density.
    remove_size : bool
        Whether the mean is taken of shapes of equal centroid size.
    n_iterations, tolerance
        Ends when the largest change of a rotation entry falls below ``tolerance``.

    Returns
    -------
    Alignment
        The mean keeps the orientation and centroid of the input mean, so that shapes that are aligned already stay.
    """
    n_shapes = len(points)
    d = points.shape[2]
    centroids = weights @ points
    centred = points - centroids[:, None]
    sizes = np.sqrt((centred**2).sum(axis=2) @ weights)
    scale = sizes.mean() / sizes if remove_size else np.ones(n_shapes)
    scaled = centred * scale[:, None, None]
    beside = scaled.transpose(1, 0, 2).reshape(-1, n_shapes * d)  # all shapes in one matrix: two products per iteration
    rotation = np.repeat(np.eye(d)[None], n_shapes, axis=0)
    start = scaled.mean(axis=0)
    mean = start
    for _ in range(n_iterations):
        cross = (weights[:, None] * mean).T @ beside
        updated = _nearest_rotations(cross.reshape(d, n_shapes, d).transpose(1, 0, 2))
        mean = beside @ np.swapaxes(updated, 1, 2).reshape(-1, d) / n_shapes
        back = rotation_between(mean, start, weights)
        mean = mean @ back.T
        updated = back @ updated
        change = float(np.abs(updated - rotation).max())
        rotation = updated
        if change < tolerance:
            break
    centre = centroids.mean(axis=0)
    translation = centre - np.einsum("iab,ib->ia", rotation, centroids)
    return Alignment(rotation, translation, scale, centre)
