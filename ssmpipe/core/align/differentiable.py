"""Rigid alignment to a fixed target as a differentiable map of the points."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.align.procrustes import rotation_between
from ssmpipe.core.arrays import Floats


def align_to(points: Floats, target: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Move (n_P, d) points rigidly as close as they come to a target.

    Parameters
    ----------
    points, target : (n_P, d) float64
        ``d`` is 2 or 3.
    weights : (n_P,) float64
        Sum 1.

    Returns
    -------
    moved : (n_P, d) float64
        With the target's centroid.
    rotation : (d, d) float64

    Examples
    --------
    >>> base = np.array([[0.0, 0], [2, 0], [0, 1]])
    >>> moved, _ = align_to(base @ np.array([[0.0, 1], [-1, 0]]) + 5, base, np.full(3, 1 / 3))
    >>> bool(np.allclose(moved, base))
    True
    """
    centred = points - weights @ points
    aimed = target - weights @ target
    rotation = rotation_between(centred, aimed, weights)
    return centred @ rotation.T + weights @ target, rotation


def align_to_adjoint(points: Floats, target: Floats, weights: Floats, rotation: Floats, d_moved: Floats) -> Floats:
    """Return ``df/d(points)`` from ``df/d(moved)`` of :func:`align_to`.

    The rotation ``R`` is the orthogonal polar factor of ``A = sum_l w_l m_l x_l^T = R S``. A change of ``A`` turns it by the
    vector ``omega`` with ``(tr(S) I - S) omega = axial(R^T dA - dA^T R)`` (a number in the plane).

    Parameters
    ----------
    points, target, weights, rotation
        As given to and returned by :func:`align_to`.
    d_moved : (n_P, d) float64
    """
    centred = points - weights @ points
    aimed = target - weights @ target
    stretch = rotation.T @ (aimed.T @ (weights[:, None] * centred))
    force = rotation.T @ (d_moved.T @ centred)
    if points.shape[1] == 2:
        spin = np.array([[0.0, (force[0, 1] - force[1, 0]) / np.trace(stretch)], [0.0, 0.0]])
        spin = spin - spin.T
    else:
        skew = force - force.T
        axial = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        symmetric = 0.5 * (stretch + stretch.T)
        v = np.linalg.solve(np.trace(symmetric) * np.eye(3) - symmetric, axial)
        spin = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    d_matrix = rotation @ spin
    d_centred = d_moved @ rotation + weights[:, None] * (aimed @ d_matrix)
    return d_centred - weights[:, None] * d_centred.sum(axis=0)
