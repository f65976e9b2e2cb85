"""Where an outline begins and ends: between two given points, or where the stem of a shape is cut off."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, points_at, resample

_CIRCLE = 1440  # angles at which a circle is tested, a quarter of a degree each
_LEAST_WIDTH = 0.8  # of a stem, in radii of the largest inscribed circle
_STEM_REMEDY = "set contour.ends to given, or show more of the shape's stem"


def between(outline: Outline, start: Floats, end: Floats) -> Outline:
    """Return the part of an outline from the point nearest to ``start`` to the point nearest to ``end``, open.

    Of the two parts of a closed outline the longer one is taken.

    Parameters
    ----------
    outline : Outline
    start, end : (2,) float64

    Raises
    ------
    GeometryError
        If both are nearest to the same point.

    Examples
    --------
    >>> square = Outline(np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]]), closed=True)
    >>> between(square, np.array([0.5, -1]), np.array([0.5, 3])).points.tolist()
    [[0.5, 0.0], [2.0, 0.0], [2.0, 2.0], [0.5, 2.0]]
    """
    at_start, at_end = _places(outline, np.stack([start, end]))
    whole = outline.length
    if abs(at_start - at_end) <= 1e-9 * whole:
        raise GeometryError(
            "start and end fall on the same point of the outline", "place them apart, or give one of them"
        )
    if not outline.closed:
        return _part(outline, at_start, at_end)
    forward = (at_end - at_start) % whole
    if forward >= 0.5 * whole:
        return _part(outline, at_start, at_start + forward)
    part = _part(outline, at_end, at_end + whole - forward)
    return Outline(part.points[::-1], False)


def _places(outline: Outline, points: Floats) -> Floats:
    """Return the arc lengths of the nearest points on an outline, (m,)."""
    _, edge, weights = point_to_segments(points, outline.points, outline.edges)
    sums = np.concatenate([[0.0], np.cumsum(outline.steps)])
    return np.asarray(sums[edge] + weights[:, 1] * outline.steps[edge])


def _part(outline: Outline, first: float, last: float) -> Outline:
    """Return the polyline between two arc lengths, backwards when the first is larger; beyond the end it goes round."""
    low, high = min(first, last), max(first, last)
    sums = np.concatenate([[0.0], np.cumsum(outline.steps)])
    corners = sums[:-1] if outline.closed else sums
    corners = np.concatenate([corners, corners + sums[-1]]) if outline.closed else corners
    margin = 1e-9 * sums[-1]
    lengths = np.concatenate([[low], corners[(corners > low + margin) & (corners < high - margin)], [high]])
    points = points_at(outline, lengths)
    return Outline(points if first <= last else points[::-1], False)


def inscribed_circle(outline: Outline) -> tuple[Floats, float]:
    """Return centre (2,) and radius of the largest circle inside an outline; an open one is closed by a straight line.

    Raises
    ------
    GeometryError
        If the outline encloses nothing.

    Examples
    --------
    >>> center, radius = inscribed_circle(Outline(np.array([[0, 0], [6, 0], [6, 2], [0, 2.0]]), closed=True))
    >>> round(float(center[1]), 2), round(radius, 2)
    (1.0, 1.0)
    """
    ring = resample(Outline(outline.points, True), 2000).points
    tree = cKDTree(ring)
    low, high = ring.min(axis=0), ring.max(axis=0)
    center, radius = low, 0.0
    for round_ in range(5):
        x, y = np.meshgrid(*(np.linspace(a, b, 48 if round_ == 0 else 12) for a, b in zip(low, high, strict=True)))
        grid = np.column_stack([x.ravel(), y.ravel()])
        distance = np.where(contains(ring, grid), tree.query(grid)[0], -1.0)
        best = int(np.argmax(distance))
        if distance[best] > radius:
            center, radius = grid[best], float(distance[best])
        step = (high - low) / (47 if round_ == 0 else 11)
        low, high = center - 1.5 * step, center + 1.5 * step
    if radius == 0.0:
        raise GeometryError("the outline encloses no area", "check the order of its points")
    return center, radius


def contains(ring: Floats, points: Floats) -> Bools:
    """Whether points lie inside a closed polyline (even-odd rule).

    Examples
    --------
    >>> contains(np.array([[0, 0], [2, 0], [0, 2.0]]), np.array([[0.5, 0.5], [1.5, 1.5]])).tolist()
    [True, False]
    """
    a, b = ring, np.roll(ring, -1, axis=0)
    inside = np.empty(len(points), dtype=bool)
    rows = max(1, 2_000_000 // len(ring))
    for begin in range(0, len(points), rows):
        x, y = points[begin : begin + rows, :, None].transpose(1, 0, 2)
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
        left = x < a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
        inside[begin : begin + rows] = (spans & left).sum(axis=1) % 2 == 1
    return inside


def cut_stem(outline: Outline, radii: float = 1.5) -> Outline:
    """Cut off the stem of a shape, as the forearm of a hand, and return what is left as an open outline.

    A circle of ``radii`` times the largest inscribed circle's radius is laid around that circle's centre. Of its arcs inside
    the shape, those that are too narrow left out (fingers), the one that cuts off the least of the outline crosses the stem;
    the outline begins and ends there. The place depends on the shape alone, not on how much of the stem is seen.

    Parameters
    ----------
    outline : Outline
        Closed; or open with both ends on the stem.
    radii : float, default=1.5

    Returns
    -------
    Outline
        Open, in the sense of the given one.

    Raises
    ------
    GeometryError
        If the circle does not cross the shape, or the shape ends within it.
    """
    center, radius = inscribed_circle(outline)
    angle = 2 * np.pi * np.arange(_CIRCLE) / _CIRCLE
    circle = center + radii * radius * np.column_stack([np.cos(angle), np.sin(angle)])
    inside = contains(outline.points, circle)
    if not inside.any() or inside.all():
        raise GeometryError(f"no stem crosses the circle of {radii:g} times the largest inscribed radius", _STEM_REMEDY)
    starts = np.flatnonzero(inside & ~np.roll(inside, 1))
    stops = starts + [int(np.argmin(np.roll(inside, -s))) - 1 for s in starts]
    ends = circle[np.stack([starts, stops % _CIRCLE], axis=1)]
    at = _places(outline, ends.reshape(-1, 2)).reshape(-1, 2)
    kept = np.abs(at[:, 1] - at[:, 0])
    if outline.closed:
        kept = np.maximum(kept, outline.length - kept)
    wide = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= _LEAST_WIDTH * radius
    if not wide.any():
        raise GeometryError(
            f"no stem wider than {_LEAST_WIDTH * radius:.4g} leaves the largest inscribed circle", _STEM_REMEDY
        )
    stem = int(np.argmax(np.where(wide, kept, -1.0)))
    gap = np.linalg.norm(points_at(outline, at[stem]) - ends[stem], axis=1).max()
    if gap > radii * radius * 6 * np.pi / _CIRCLE + 0.02 * radius:
        raise GeometryError(
            f"the shape ends within {radii:g} times the radius of its largest inscribed circle ({radius:.4g})",
            _STEM_REMEDY,
        )
    part = between(outline, *points_at(outline, np.sort(at[stem])))
    return Outline(part.points[::-1], False) if _reversed(outline, part) else part


def _reversed(outline: Outline, part: Outline) -> bool:
    """Whether a part runs against the outline that it was cut from."""
    places = _places(outline, part.points[[len(part.points) // 3, len(part.points) // 3 + 1]])
    step = float(places[1] - places[0])
    return step < 0 if abs(step) < 0.5 * outline.length else step > 0
