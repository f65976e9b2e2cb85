"""Triangles over a regular grid of points."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Ints


def grid_faces(
    n_u: int, n_v: int, *, periodic_u: bool = False, pole_start: bool = False, pole_end: bool = False
) -> Ints:
    """Return the triangles of a row-major grid, counter-clockwise in (u, v).

    Each cell is split along the diagonal from its (0, 0) to its (1, 1) corner.

    Parameters
    ----------
    n_u, n_v : int
    periodic_u : bool, default=False
        Whether the last row of the grid is joined to the first one (a tube whose seam is stored once).
    pole_start, pole_end : bool, default=False
        Whether all points of the first or the last column are the same one. All triangles there use its first copy, so that the
        surface has no gap, and those without area are left out.

    Returns
    -------
    (2 (n_u - 1) (n_v - 1), 3) int64
        ``2 n_u (n_v - 1)`` triangles when periodic, ``n_u`` less per pole.

    Examples
    --------
    >>> grid_faces(2, 2)
    array([[0, 2, 3],
           [0, 3, 1]])
    >>> len(grid_faces(5, 3, periodic_u=True))
    20
    >>> grid_faces(3, 2, periodic_u=True, pole_end=True)
    array([[0, 2, 1],
           [2, 4, 1],
           [4, 0, 1]])
    """
    index = np.arange(n_u * n_v, dtype=np.int64).reshape(n_u, n_v)
    for pole, column in ((pole_start, 0), (pole_end, -1)):
        if pole:
            index[:, column] = index[0, column]
    if periodic_u:
        index = np.concatenate([index, index[:1]])
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
