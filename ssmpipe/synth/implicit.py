"""Bodies as functions that are negative inside: a few primitives, blended smoothly."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np

from ssmpipe.core.arrays import Floats, Ints

Field = Callable[[Floats], Floats]
"""Maps (n, 3) points [mm] to (n,) values, about the signed distance near the surface."""


def ellipsoid(points: Floats, centre: tuple[float, ...], radii: tuple[float, ...]) -> Floats:
    """Approximate signed distance to an ellipsoid, exact on its surface to first order.

    Examples
    --------
    >>> float(ellipsoid(np.array([[3.0, 0, 0]]), (0, 0, 0), (2, 2, 2))[0])
    1.0
    """
    scaled = (points - np.array(centre)) / np.array(radii)
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / np.array(radii), axis=1)
    return length * (length - 1) / np.maximum(slope, 1e-9)


def round_cone(points: Floats, start: tuple[float, ...], end: tuple[float, ...], radii: tuple[float, float]) -> Floats:
    """Distance to the union of spheres whose radii go linearly from one end to the other (to first order).

    Examples
    --------
    >>> float(round_cone(np.array([[0.0, 5, 1]]), (0, 0, 0), (0, 0, 2), (1, 1))[0])
    4.0
    """
    a, b = np.array(start, dtype=float), np.array(end, dtype=float)
    t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - t[:, None] * (b - a), axis=1) - (radii[0] + t * (radii[1] - radii[0]))


def smooth_union(a: Floats, b: Floats, width: float) -> Floats:
    """Blend two fields over ``width`` [mm] (the polynomial minimum of Quilez, 2013).

    Examples
    --------
    >>> smooth_union(np.array([0.0, 9.0]), np.array([0.0, 1.0]), 4.0).tolist()
    [-1.0, 1.0]
    """
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - h * h * width / 4


def smooth_cut(a: Floats, b: Floats, width: float) -> Floats:
    """Remove the body ``b`` from the body ``a``, with an edge rounded over ``width`` [mm]."""
    return -smooth_union(-a, b, width)


def polygonize(field: Field, lower: Floats, upper: Floats, spacing: float, turn: Floats) -> tuple[Floats, Ints]:
    """Return the zero surface of a field by marching cubes (Lorensen and Cline, 1987) on a turned grid.

    Parameters
    ----------
    field : callable
        Negative inside.
    lower, upper : (3,) float64
        Box that holds the body [mm].
    spacing : float
        Grid spacing [mm].
    turn : (4, 4) float64
        Rigid motion of the grid: another one gives another connectivity of the same surface.

    Returns
    -------
    vertices : (n, 3) float64
    faces : (m, 3) int64
        Outward.
    """
    centre, radius = (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2 + 2 * spacing
    axis = np.arange(-radius, radius + spacing, spacing)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    grid = np.stack([x, y, z], axis=-1).reshape(-1, 3) @ turn[:3, :3].T + turn[:3, 3] + centre
    inside = np.all((grid > lower - 2 * spacing) & (grid < upper + 2 * spacing), axis=1)
    values = np.full(len(grid), 4 * spacing)
    values[inside] = field(grid[inside])
    vertices, faces, _ = igl.marching_cubes(values, grid, len(axis), len(axis), len(axis), 0.0)
    faces = np.asarray(faces, dtype=np.int64)
    corners = vertices[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return vertices, (faces if volume > 0 else faces[:, ::-1])


def project(field: Field, points: Floats, n_steps: int = 8) -> Floats:
    """Move points onto the zero surface along the gradient (Newton steps with central differences).

    Examples
    --------
    >>> ball = lambda p: ellipsoid(p, (0, 0, 0), (2, 2, 2))
    >>> project(ball, np.array([[2.5, 0.0, 0.0]])).round(9).tolist()
    [[2.0, 0.0, 0.0]]
    """
    points = np.array(points, dtype=np.float64)
    for _ in range(n_steps):
        gradient = field_gradient(field, points)
        points -= (field(points) / np.maximum((gradient**2).sum(axis=1), 0.05))[:, None] * gradient
    return points


def field_gradient(field: Field, points: Floats, step: float = 1e-4) -> Floats:
    """Return the (n, 3) gradient of a field by central differences."""
    shifts = step * np.eye(3)
    return np.stack([(field(points + e) - field(points - e)) / (2 * step) for e in shifts], axis=1)
