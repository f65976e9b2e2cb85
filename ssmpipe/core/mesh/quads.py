"""Quadrilaterals over a grid of points, and how well they are shaped."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


def grid_quads(n_u: int, n_v: int, *, periodic_u: bool = False) -> Ints:
    """Return the quadrilaterals of a row-major grid, counter-clockwise in (u, v).

    Returns
    -------
    ((n_u - 1) (n_v - 1), 4) int64
        ``n_u (n_v - 1)`` rows when the last row of the grid is joined to the first one.

    Examples
    --------
    >>> grid_quads(2, 2)
    array([[0, 2, 3, 1]])
    """
    index = np.arange(n_u * n_v, dtype=np.int64).reshape(n_u, n_v)
    if periodic_u:
        index = np.concatenate([index, index[:1]])
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([c.ravel() for c in corners], axis=1)


def scaled_jacobian(points: Floats, quads: Ints) -> Floats:
    """Return the scaled Jacobian of each quadrilateral: 1 is a rectangle, 0 and less cannot be used (Knupp 2000).

    It is the smallest, over the four corners, of the area that the two edges span (against the normal in the middle) over the
    product of their lengths. A quadrilateral with an edge of no length has 0.

    Parameters
    ----------
    points : (n, 3) float64
    quads : (n_quads, 4) int64

    Returns
    -------
    (n_quads,) float64
        In [-1, 1].

    Examples
    --------
    >>> square = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.0]])
    >>> scaled_jacobian(square, np.array([[0, 1, 2, 3]]))
    array([1.])
    """
    corners = points[quads]
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=2)
    principal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    tiny = np.finfo(np.float64).tiny
    normal = principal / np.maximum(np.linalg.norm(principal, axis=1), tiny)[:, None]
    areas = np.einsum("qkd,qd->qk", np.cross(np.roll(edges, 1, axis=1), edges), normal)
    scale = lengths * np.roll(lengths, 1, axis=1)
    return np.asarray(np.where(scale > 0, areas / np.maximum(scale, tiny), 0.0).min(axis=1))
