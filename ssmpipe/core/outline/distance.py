"""Nearest points on polylines."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Floats, Ints

_NEAR = 8


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
    best, edge, share = np.empty(len(points)), np.empty(len(points), dtype=np.int64), np.empty(len(points))
    left = np.arange(len(points))
    if len(edges) > 4 * _NEAR:
        # candidates by the distance of their middles; the rest cannot be nearer when the last candidate is too far
        reach = 0.5 * float(np.sqrt(square.max()))
        far, near = cKDTree(start + 0.5 * along).query(points, k=_NEAR)
        near = np.sort(near, axis=1)
        best, edge, share = _nearest(points, start, along, square, near)
        left = np.flatnonzero(far[:, -1] - reach <= best * (1 + 1e-12))
    rows = max(1, 4_000_000 // len(edges))
    every = np.arange(len(edges))[None]
    for begin in range(0, len(left), rows):
        part = left[begin : begin + rows]
        best[part], edge[part], share[part] = _nearest(points[part], start, along, square, every)
    return best, edge, np.column_stack([1.0 - share, share])


def _nearest(
    points: Floats, start: Floats, along: Floats, square: Floats, candidates: Ints
) -> tuple[Floats, Ints, Floats]:
    """Return distance, edge and place on it for every point among its (m, k) or all points' (1, k) candidates."""
    offset = points[:, None] - start[candidates]
    t = np.clip((offset * along[candidates]).sum(axis=2) / square[candidates], 0.0, 1.0)
    distances = np.linalg.norm(offset - t[..., None] * along[candidates], axis=2)
    nearest = distances.argmin(axis=1)
    at = np.arange(len(nearest))
    return distances[at, nearest], np.broadcast_to(candidates, distances.shape)[at, nearest], t[at, nearest]
