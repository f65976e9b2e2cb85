"""Triangles over a regular grid of points."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Ints


def grid_faces(n_u: int, n_v: int, *, periodic_u: bool = False) -> Ints:
    """Return the triangles of a row-major grid, counter-clockwise in (u, v).

    Each cell is split along the diagonal from its (0, 0) to its (1, 1) corner.

    Parameters
    ----------
    n_u, n_v : int
    periodic_u : bool, default=False
        Whether the last row of the grid is joined to the first one (a tube whose seam is stored once).

    Returns
    -------
    (2 (n_u - 1) (n_v - 1), 3) int64
        ``2 n_u (n_v - 1)`` triangles when periodic.

    Examples
    --------
    >>> grid_faces(2, 2)
    array([[0, 2, 3],
           [0, 3, 1]])
    >>> len(grid_faces(5, 3, periodic_u=True))
    20
    """
    index = np.arange(n_u * n_v, dtype=np.int64).reshape(n_u, n_v)
    if periodic_u:
        index = np.concatenate([index, index[:1]])
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
