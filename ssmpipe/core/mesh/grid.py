"""Triangles over a regular grid of points."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Ints


def grid_faces(n_u: int, n_v: int) -> Ints:
    """Return the (2 (n_u - 1) (n_v - 1), 3) triangles of a row-major grid, counter-clockwise in (u, v).

    Each cell is split along the diagonal from its (0, 0) to its (1, 1) corner.

    Examples
    --------
    >>> grid_faces(2, 2)
    array([[0, 2, 3],
           [0, 3, 1]])
    """
    index = np.arange(n_u * n_v, dtype=np.int64).reshape(n_u, n_v)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
