"""Sections of a tube across its centre line: how wide they are, and how lobed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.sections import section_segments
from ssmpipe.core.mesh.trimesh import TriMesh


@dataclass(frozen=True, eq=False)
class TubeProfile:
    """Plane sections at places along a centre line.

    Attributes
    ----------
    at : (n,) float64
        Arc length of each section from the start of the line [mm].
    diameter : (n,) float64
        Of a circle with the area of the section [mm]; NaN where the section is not whole.
    lobes : (n_orders, n) float64
        Row m - 2: amplitude of the m-th wave of the radius around the section's centre [mm]; 2 oval, 3 three-lobed ...
    points, tangents : (n, 3) float64
        Of the line.
    """

    at: Floats
    diameter: Floats
    lobes: Floats
    points: Floats
    tangents: Floats


def tube_profile(mesh: TriMesh, line: Floats, step: float, window: float, n_orders: int = 2) -> TubeProfile:
    """Cut a tube across its centre line at equal steps.

    Parameters
    ----------
    mesh : TriMesh
        Open at both ends; of an arch only the limb is cut that the place of the line belongs to.
    line : (n, 3) float64
        See :func:`ssmpipe.core.mesh.centre_line.centre_line`.
    step : float
        Distance of the sections [mm].
    window : float
        Half the length of line to which a parabola is fitted for its direction [mm]; about a radius.
    n_orders : int
        Number of waves, from the second on.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> line = np.linspace([0, 0, 0.0], [0, 0, 10.0], 41)
    >>> profile = tube_profile(tube(radius=2.0, height=10.0, n_around=60), line, 1.0, 2.0)
    >>> bool(np.abs(profile.diameter[1:-1] - 4.0).max() < 0.02), bool(profile.lobes[:, 1:-1].max() < 0.01)
    (True, True)
    """
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    at = np.arange(0.0, length[-1] + 0.5 * step, step)
    even = np.column_stack([np.interp(at, length, line[:, d]) for d in range(3)])
    diameter, lobes = np.full(len(at), np.nan), np.full((n_orders, len(at)), np.nan)
    points, tangents = even.copy(), np.empty_like(even)
    for k, place in enumerate(at):
        points[k], tangents[k] = point_on_line(line, float(place), window)
        segments = section_segments(mesh, tangents[k], float(points[k] @ tangents[k]))
        middle = segments.mean(axis=1)
        apart = np.linalg.norm(middle[:, None] - even[None, :: max(1, int(window / step) // 2)], axis=2)
        nearest = at[:: max(1, int(window / step) // 2)][apart.argmin(axis=1)] if len(middle) else np.empty(0)
        segments = segments[np.abs(nearest - place) < 2.0 * window]
        diameter[k], lobes[:, k] = _round(segments, tangents[k], n_orders)
    return TubeProfile(at, diameter, lobes, points, tangents)


def point_on_line(line: Floats, at: float, window: float) -> tuple[Floats, Floats]:
    """Return the point of a polyline at an arc length, and its unit tangent, from a parabola through what lies near it.

    Parameters
    ----------
    line : (n, 3) float64
        [mm]
    at, window : float
        Arc length from the start, and half the length of line to which the parabola is fitted [mm].

    Returns
    -------
    point, tangent : (3,) float64

    Raises
    ------
    GeometryError
        If the line has no length.

    Examples
    --------
    >>> point, tangent = point_on_line(np.array([[0.0, 0, 0], [0, 0, 4]]), 1.0, 2.0)
    >>> point.round(9), tangent.round(9)
    (array([0., 0., 1.]), array([0., 0., 1.]))
    """
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    low, high = np.clip([at - window, at + window], 0.0, length[-1])
    if high <= low:
        raise GeometryError("the centre line of the tube has no length", "check that the scan is a tube")
    places = np.linspace(low, high, 41)
    near = np.column_stack([np.interp(places, length, line[:, d]) for d in range(3)])
    offset = (places - at) / window
    tangent = np.linalg.lstsq(np.column_stack([np.ones(41), offset, offset**2]), near, rcond=None)[0][1]
    point = np.array([np.interp(at, length, line[:, d]) for d in range(3)])
    return point, tangent / np.linalg.norm(tangent)


def point_on_longer_line(line: Floats, at: float, window: float) -> tuple[Floats, Floats]:
    """Return point and tangent as :func:`point_on_line` does; near its ends, where rims are ragged, and beyond, the line is straight.

    Examples
    --------
    >>> point, tangent = point_on_longer_line(np.array([[0.0, 0, 0], [0, 0, 4]]), 5.0, 2.0)
    >>> point.round(9), tangent.round(9)
    (array([0., 0., 5.]), array([0., 0., 1.]))
    """
    total = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    inside = float(np.clip(at, 0.35 * window, total - 0.35 * window))
    point, tangent = point_on_line(line, inside, window)
    return point + (at - inside) * tangent, tangent


def places_on_line(line: Floats, points: Floats) -> Floats:
    """Return the arc lengths (n,) of the vertices of a polyline that lie nearest to (n, 3) points [mm].

    Examples
    --------
    >>> places_on_line(np.array([[0.0, 0, 0], [0, 0, 2], [0, 0, 4]]), np.array([[1.0, 0, 2.5], [0, 0, 9]]))
    array([2., 4.])
    """
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    return np.asarray(length[np.linalg.norm(points[:, None] - line, axis=2).argmin(axis=1)])


def _round(segments: Floats, axis: Floats, n_orders: int) -> tuple[float, Floats]:
    """Return the diameter of the circle of equal area and the amplitudes of the waves; NaN unless the section closes."""
    nothing = float("nan"), np.full(n_orders, np.nan)
    if len(segments) < 6:
        return nothing
    middle = segments.mean(axis=(0, 1))
    for _ in range(2):
        p, q = segments[:, 0] - middle, segments[:, 1] - middle
        twice = np.cross(p, q) @ axis
        if twice.sum() <= 0:
            return nothing
        middle = middle + (twice @ (p + q)) / (3.0 * twice.sum())
    p, q = segments[:, 0] - middle, segments[:, 1] - middle
    turn = np.arctan2(np.cross(p, q) @ axis, (p * q).sum(axis=1))
    if abs(turn.sum() - 2.0 * np.pi) > 0.1:
        return nothing
    x = np.linalg.svd(np.eye(3) - np.outer(axis, axis))[0][:, 0]
    half = 0.5 * (p + q)
    angle, radius = np.arctan2(half @ np.cross(axis, x), half @ x), np.linalg.norm(half, axis=1)
    waves = [abs((radius * np.exp(-1j * m * angle) * turn).sum()) / np.pi for m in range(2, 2 + n_orders)]
    return float(np.sqrt(2.0 * twice.sum() / np.pi)), np.array(waves)
