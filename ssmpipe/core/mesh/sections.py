"""Plane sections of a surface: area, middle, extent."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.trimesh import TriMesh


def section_segments(mesh: TriMesh, axis: Floats, height: float) -> Floats:
    """Return the directed segments (n, 2, 3) in which the plane ``x . axis = height`` cuts the faces.

    Around a closed outward surface they run counter-clockwise seen against ``axis``.
    """
    return level_segments(mesh, mesh.vertices @ axis - height)


def level_segments(mesh: TriMesh, level: Floats) -> Floats:
    """Return the directed segments (n, 2, 3) along which a function, linear on faces, is zero.

    Parameters
    ----------
    mesh : TriMesh
    level : (n_vertices,) float64
        The function at the vertices.
    """
    return segments_on_faces(mesh, level)[0]


def segments_on_faces(mesh: TriMesh, level: Floats) -> tuple[Floats, Ints]:
    """Return the segments of :func:`level_segments`, and the face (n,) that each lies on."""
    above = level[mesh.faces] > 0
    count = above.sum(axis=1)
    crossed = np.flatnonzero((count == 1) | (count == 2))
    faces, above, count = mesh.faces[crossed], above[crossed], count[crossed]
    lone = np.where(count == 1, np.argmax(above, axis=1), np.argmin(above, axis=1))
    index = (np.arange(3)[None, :] + lone[:, None]) % 3
    a, b, c = np.take_along_axis(faces, index, axis=1).T
    ends = []
    for other in (b, c):
        t = level[a] / (level[a] - level[other])
        ends.append((1.0 - t)[:, None] * mesh.vertices[a] + t[:, None] * mesh.vertices[other])
    first, second = ends
    up = (count == 1)[:, None]
    return np.stack([np.where(up, first, second), np.where(up, second, first)], axis=1), crossed


def section_areas(mesh: TriMesh, axis: Floats, heights: Floats) -> tuple[Floats, Floats]:
    """Return areas and centroids of plane sections.

    Parameters
    ----------
    mesh : TriMesh
        Closed and outward where it is cut.
    axis : (3,) float64
        Unit normal of the planes.
    heights : (n,) float64
        Along the axis [mm].

    Returns
    -------
    areas : (n,) float64
        Enclosed area [mm^2]; inner walls count as negative. Zero where the plane misses.
    centroids : (n, 3) float64
        Centroids of the enclosed areas [mm]; NaN where the plane misses.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> area, middle = section_areas(tube(n_around=4), np.array([0, 0, 1.0]), np.array([1.1]))
    >>> bool(np.isclose(area[0], 2.0)), bool(np.allclose(middle, [0, 0, 1.1]))
    (True, True)
    """
    areas, centroids = np.zeros(len(heights)), np.full((len(heights), 3), np.nan)
    for k, height in enumerate(heights):
        segments = section_segments(mesh, axis, float(height))
        if len(segments) == 0:
            continue
        origin = segments.mean(axis=(0, 1))
        p, q = segments[:, 0] - origin, segments[:, 1] - origin
        twice = np.cross(p, q) @ axis
        areas[k] = 0.5 * twice.sum()
        if areas[k] > 0:
            centroids[k] = origin + (twice @ (p + q)) / (6.0 * areas[k])
    return areas, centroids
