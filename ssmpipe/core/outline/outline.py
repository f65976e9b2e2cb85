"""A planar outline: ordered points, open or closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Bools, Floats, Ints, frozen
from ssmpipe.core.errors import GeometryError


@dataclass(frozen=True, eq=False)
class Outline:
    """Polyline in the plane.

    Parameters
    ----------
    points : (n, 2) float64
        Ordered; the first is not repeated when closed.
    closed : bool
        Whether the last point is joined to the first.

    Raises
    ------
    GeometryError
        If points are not finite pairs, or fewer than 2 (3 when closed).

    Examples
    --------
    >>> square = Outline(np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]]), closed=True)
    >>> square.length, square.signed_area
    (8.0, 4.0)
    """

    points: Floats
    closed: bool

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise GeometryError(f"an outline needs finite points of shape (n, 2), got shape {points.shape}")
        least = 3 if self.closed else 2
        if len(points) < least:
            raise GeometryError(f"the outline has {len(points)} points, at least {least} are needed")
        object.__setattr__(self, "points", frozen(points, np.float64))
        object.__setattr__(self, "closed", bool(self.closed))

    @property
    def ring(self) -> Floats:
        """Points with the first repeated at the end when closed."""
        return np.concatenate([self.points, self.points[:1]]) if self.closed else self.points

    @property
    def edges(self) -> Ints:
        """Index pairs of neighbours, (n_edges, 2)."""
        return edge_indices(len(self.points), self.closed)

    @property
    def steps(self) -> Floats:
        """Lengths of the edges, (n_edges,)."""
        return np.asarray(np.linalg.norm(np.diff(self.ring, axis=0), axis=1))

    @property
    def length(self) -> float:
        """Length of the polyline, in the unit of the points."""
        return float(self.steps.sum())

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def signed_area(self) -> float:
        """Enclosed area, positive when counter-clockwise with x right and y up; an open outline is closed by a straight line."""
        x, y = (self.points - self.points.mean(axis=0)).T
        return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def edge_indices(n_points: int, closed: bool) -> Ints:
    """Return index pairs of neighbours on a polyline, (n_edges, 2).

    Examples
    --------
    >>> edge_indices(3, True).tolist()
    [[0, 1], [1, 2], [2, 0]]
    """
    start = np.arange(n_points if closed else n_points - 1)
    return np.column_stack([start, (start + 1) % n_points])


def points_at(outline: Outline, lengths: Floats) -> Floats:
    """Return the points at arc lengths from the first point; taken modulo the whole length when closed.

    Examples
    --------
    >>> points_at(Outline(np.array([[0, 0], [2, 0], [2, 2.0]]), closed=False), np.array([3.0]))
    array([[2., 1.]])
    """
    sums = np.concatenate([[0.0], np.cumsum(outline.steps)])
    at = np.mod(lengths, sums[-1]) if outline.closed else np.clip(lengths, 0.0, sums[-1])
    return np.column_stack([np.interp(at, sums, column) for column in outline.ring.T])


def resample(outline: Outline, n: int) -> Outline:
    """Return ``n`` points at equal arc lengths; both ends included when open.

    Examples
    --------
    >>> resample(Outline(np.array([[0, 0], [4.0, 0]]), closed=False), 3).points
    array([[0., 0.],
           [2., 0.],
           [4., 0.]])
    """
    share = np.arange(n) / n if outline.closed else np.linspace(0.0, 1.0, n)
    return Outline(points_at(outline, share * outline.length), outline.closed)


def start_at(outline: Outline, length: float) -> Outline:
    """Return the same closed polyline begun at an arc length from its first point; a new point is put there if none is near.

    Raises
    ------
    GeometryError
        If the outline is open.

    Examples
    --------
    >>> square = Outline(np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]]), closed=True)
    >>> start_at(square, 3.0).points[:2]
    array([[2., 1.],
           [2., 2.]])
    """
    if not outline.closed:
        raise GeometryError("the first point of an open outline cannot be moved")
    sums = np.concatenate([[0.0], np.cumsum(outline.steps)])
    at = float(np.mod(length, sums[-1]))
    near = int(np.abs(sums - at).argmin())
    n = len(outline.points)
    if abs(sums[near] - at) <= 1e-9 * sums[-1]:
        return Outline(np.roll(outline.points, -(near % n), axis=0), True)
    after = int(np.searchsorted(sums, at))
    rolled = np.roll(outline.points, -(after % n), axis=0)
    return Outline(np.concatenate([points_at(outline, np.array([at])), rolled]), True)


def without_repeats(outline: Outline) -> Outline:
    """Return the outline without points that repeat the one before."""
    keep = np.ones(len(outline.points), dtype=bool)
    keep[1:] = np.any(np.diff(outline.points, axis=0) != 0, axis=1)
    points = outline.points[keep]
    if outline.closed and len(points) > 1 and np.array_equal(points[0], points[-1]):
        points = points[:-1]
    return Outline(points, outline.closed)


def crossings(outline: Outline) -> Ints:
    """Return the pairs of edges that properly cross each other, (n, 2) edge indices; touching does not count.

    Examples
    --------
    >>> eight = Outline(np.array([[0, 0], [2, 2], [2, 0], [0, 2.0]]), closed=True)
    >>> crossings(eight).tolist()
    [[0, 2]]
    """
    a, b = outline.points[outline.edges[:, 0]], outline.points[outline.edges[:, 1]]
    found: list[Ints] = []
    rows = max(1, 2_000_000 // len(a))
    for start in range(0, len(a), rows):
        i = np.arange(start, min(start + rows, len(a)))
        one = _sides(a[i, None], b[i, None], a[None], b[None])
        two = _sides(a[None], b[None], a[i, None], b[i, None])
        first, second = np.nonzero(one & two & (np.arange(len(a))[None] > i[:, None]))
        found.append(np.column_stack([i[first], second]))
    return np.concatenate(found)


def _sides(a: Floats, b: Floats, c: Floats, d: Floats) -> Bools:
    """Whether c and d lie strictly on opposite sides of the line through a and b."""
    edge = b - a

    def side(p: Floats) -> Floats:
        return np.asarray(edge[..., 0] * (p - a)[..., 1] - edge[..., 1] * (p - a)[..., 0])

    return np.asarray(np.sign(side(c)) * np.sign(side(d)) < 0)
