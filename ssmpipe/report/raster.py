"""Fast shaded pictures of triangle surfaces, with nothing but numpy."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints

_LIGHT = np.array([-0.35, 0.45, 0.82])
_RIM = 1e-5  # of a triangle: so much beyond its edge belongs to it, lest two neighbours leave a gap
_BLOCK = 3_000_000  # pixels that are tested at a time


def rasterize(points: Floats, normals: Floats, faces: Ints, colours: Floats, size: int) -> np.ndarray:
    """Return a (size, size, 3) uint8 picture on white of a surface that has been turned towards the viewer.

    Every triangle is tested against the centres of the pixels in its box, and the nearest one of each pixel is kept (a depth
    buffer); colour times shade is interpolated linearly over the triangle.

    Parameters
    ----------
    points : (n, 3) float64
        x to the right, y upwards, z towards the viewer; the picture shows [-1, 1] x [-1, 1].
    normals : (n, 3) float64
        Unit, outward, in the same frame. The inside of the surface is drawn darker.
    faces : (n_F, 3) int64
    colours : (n, 3) float64
        In [0, 1].
    size : int
        Pixels.

    Examples
    --------
    >>> square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    >>> up = np.tile([0, 0, 1.0], (4, 1))
    >>> shot = rasterize(square, up, np.array([[0, 1, 2], [0, 2, 3]]), np.ones((4, 3)), 8)
    >>> (shot[:, :, 0] < 255).astype(int)[4]
    array([0, 0, 1, 1, 1, 1, 0, 0])
    """
    corners = points[faces]
    ahead = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] >= 0
    normal = np.where(ahead[:, None, None], normals[faces], -normals[faces])
    lit = np.clip(normal @ _LIGHT, 0, 1)
    shade = (0.44 + 0.54 * lit + 0.05 * lit**12) * np.where(ahead, 1.0, 0.62)[:, None]
    values = np.concatenate([corners, np.clip(colours[faces] * shade[:, :, None], 0, 1)], axis=2)
    values[:, :, 0] = (values[:, :, 0] + 1) * size / 2
    values[:, :, 1] = (1 - values[:, :, 1]) * size / 2
    x, y = values[:, :, 0], values[:, :, 1]
    # weights of corners 1 and 2 are linear in the place: coefficient of x, of y, constant
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    some = np.flatnonzero(np.abs(area) > 1e-9)
    x, y, values, area = x[some], y[some], values[some], area[some]
    one = (np.stack([y[:, 2] - y[:, 0], x[:, 0] - x[:, 2]], axis=1) / area[:, None]).astype(np.float32)
    two = (np.stack([y[:, 0] - y[:, 1], x[:, 1] - x[:, 0]], axis=1) / area[:, None]).astype(np.float32)
    left, right, top, bottom = (
        np.clip(edge, 0, size).astype(np.int64)
        for edge in (np.floor(x.min(axis=1)), np.ceil(x.max(axis=1)), np.floor(y.min(axis=1)), np.ceil(y.max(axis=1)))
    )
    sides = np.unique(np.ceil(1.3 ** np.arange(32)).astype(np.int64))  # few sizes of box, so that few steps are needed
    box = sides[np.searchsorted(sides, np.clip(np.maximum(right - left, bottom - top), 1, sides[-1]))]
    nearest = np.full(size * size, -np.inf)
    shown = np.full(size * size, -1, dtype=np.int64)  # the triangle that each pixel shows, and where in it
    weights = np.zeros((size * size, 2))
    for n in np.unique(box):
        offset = np.arange(n)
        group = np.flatnonzero(box == n)
        rows = max(1, _BLOCK // len(offset) ** 2)
        for start in range(0, len(group), rows):
            part = group[start : start + rows]
            column, row = left[part, None] + offset, top[part, None] + offset
            px, py = (column + 0.5 - x[part, :1]).astype(np.float32), (row + 0.5 - y[part, :1]).astype(np.float32)
            px[column >= size], py[row >= size] = np.nan, np.nan  # no comparison is true outside of the picture
            w1, w2 = (
                (k[part, :1] * px)[:, :, None] + (k[part, 1:] * py)[:, None, :] for k in (one, two)
            )  # (triangles, columns, rows)
            which, i, j = np.nonzero((w1 >= -_RIM) & (w2 >= -_RIM) & (w1 + w2 <= 1 + _RIM))
            at = row[which, j] * size + column[which, i]
            w = np.stack([w1[which, i, j], w2[which, i, j]], axis=1).astype(np.float64)
            which = part[which]
            z = values[which, :, 2]
            depth = z[:, 0] + w[:, 0] * (z[:, 1] - z[:, 0]) + w[:, 1] * (z[:, 2] - z[:, 0])
            closer = np.flatnonzero(depth > nearest[at])
            at, which, w, depth = at[closer], which[closer], w[closer], depth[closer]
            np.maximum.at(nearest, at, depth)
            front = np.flatnonzero(depth == nearest[at])
            shown[at[front]], weights[at[front]] = which[front], w[front]
    picture = np.ones((size * size, 3))
    drawn = np.flatnonzero(shown >= 0)
    colour, w = values[shown[drawn], :, 3:], weights[drawn]
    w0 = 1 - w[:, 0] - w[:, 1]
    picture[drawn] = w0[:, None] * colour[:, 0] + w[:, :1] * colour[:, 1] + w[:, 1:] * colour[:, 2]
    return (255 * picture.reshape(size, size, 3)).round().astype(np.uint8)


def thinned(points: Floats, faces: Ints, cell: float) -> tuple[Ints, Ints]:
    """Return a coarser surface for a small picture: one point per cube of side ``cell``, faces between them.

    Returns
    -------
    kept : (m,) int64
        Indices into ``points``.
    faces : (k, 3) int64
        Indices into ``kept``.

    Examples
    --------
    >>> strip = np.array([[0, 0, 0], [0, 1, 0], [0.1, 0, 0], [5, 0, 0.0]])
    >>> kept, faces = thinned(strip, np.array([[0, 1, 2], [1, 2, 3]]), 0.5)
    >>> kept, faces
    (array([0, 1, 3]), array([[1, 0, 2]]))
    """
    cube = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    n_y, n_z = cube[:, 1:].max(axis=0) + 1
    key = (cube[:, 0] * n_y + cube[:, 1]) * n_z + cube[:, 2]  # in the order of the rows, and much faster to sort
    _, kept, number = np.unique(key, return_index=True, return_inverse=True)
    order = np.argsort(kept)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    moved = rank[number.ravel()][faces]
    a, b, c = moved.T
    return kept[order], moved[(a != b) & (b != c) & (c != a)]
