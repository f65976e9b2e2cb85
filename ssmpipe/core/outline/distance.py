"""Nearest points on polylines."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


def point_to_segments(points: Floats, vertices: Floats, edges: Ints) -> tuple[Floats, Ints, Floats]:
    """Return the distance to the nearest segment, its index, and the barycentric coordinates of the nearest point on it.

    Parameters
    ----------
    points : (m, d) float64
    vertices : (n, d) float64
    edges : (n_edges, 2) int64

    Returns
    -------
    distance : (m,) float64
        In the unit of the points.
    edge : (m,) int64
        The first of equally near ones.
    barycentric : (m, 2) float64

    Examples
    --------
    >>> point_to_segments(np.array([[1.0, 3.0]]), np.array([[0, 0], [4.0, 0]]), np.array([[0, 1]]))
    (array([3.]), array([0]), array([[0.75, 0.25]]))
    """
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    square = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)
    best = np.empty(len(points))
    edge = np.empty(len(points), dtype=np.int64)
    share = np.empty(len(points))
    rows = max(1, 4_000_000 // len(edges))
    for begin in range(0, len(points), rows):
        part = slice(begin, begin + rows)
        offset = points[part, None] - start[None]
        t = np.clip((offset * along).sum(axis=2) / square, 0.0, 1.0)
        distances = np.linalg.norm(offset - t[..., None] * along, axis=2)
        nearest = distances.argmin(axis=1)
        at = np.arange(len(nearest))
        best[part], edge[part], share[part] = distances[at, nearest], nearest, t[at, nearest]
    return best, edge, np.column_stack([1.0 - share, share])
