"""The plane through a point that cuts a tube in the smallest section: across the tube, whatever bulges on one of its sides."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import face_normals
from ssmpipe.core.mesh.sections import segments_on_faces
from ssmpipe.core.mesh.trimesh import TriMesh

_NEAR, _FARTHEST = 0.1, 0.3
"""Planes tilted by so much have to cut the tube all around; the smallest section is not tilted farther [tangent of the angle]."""


def narrowest_section(mesh: TriMesh, point: Floats, normal: Floats, reach: float) -> Floats | None:
    """Return the unit normal, less than 17 degrees from the given one, of the smallest plane section of a tube through a point.

    Parameters
    ----------
    mesh : TriMesh
        Outward [mm].
    point, normal : (3,) float64
        A place inside the tube, and about its direction there (unit).
    reach : float
        Sections count as far as this from the point, so that of an arch one limb is cut [mm].

    Returns
    -------
    (3,) float64, or None
        None where planes near the given one do not cut the tube all around: at its ends, and beyond.

    Notes
    -----
    When the plane turns about the point by a small ``w``, a place ``x`` of the section is left behind by ``h = w . ((x - p) x n)`` and
    slides along the wall: with the wall's normal ``N`` and the outward normal ``m`` of the section in its plane, the area grows by
    the integral of ``-h (N . n) / (N . m)``. On a mesh that is exact, segment by segment; the smallest section is where it vanishes.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> pipe = tube(radius=2.0, height=10.0, n_around=60)
    >>> narrowest_section(pipe, np.array([0, 0, 5.0]), np.array([0, 0.1, 0.995]), 4.0).round(6) + 0.0
    array([0., 0., 1.])
    >>> narrowest_section(pipe, np.array([0, 0, 0.05]), np.array([0, 0, 1.0]), 4.0) is None
    True
    """
    across = np.linalg.svd(normal[None])[2][1:]
    walls = face_normals(mesh)

    def tilted(by: Floats) -> Floats:
        turned = normal + by @ across
        return np.asarray(turned / np.linalg.norm(turned))

    def growth(by: Floats) -> Floats:
        return _growth(mesh, walls, point, tilted(by), reach) @ across.T

    around = _NEAR * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    if not np.isfinite([growth(by) for by in around]).all():
        return None
    found = root(growth, np.zeros(2), tol=1e-12)
    # near the zero rounding hides all progress, which root calls a failure
    still = np.abs(growth(found.x)).max() < 1e-6 * np.abs(growth(around[0])).max()
    return tilted(found.x) if still and found.x @ found.x < _FARTHEST**2 else None


def _growth(mesh: TriMesh, walls: Floats, point: Floats, normal: Floats, reach: float) -> Floats:
    """Return the derivative of the area by the tilt of the normal, (3,) [mm^2], NaN unless the section goes around the point."""
    segments, faces = segments_on_faces(mesh, (mesh.vertices - point) @ normal)
    near = np.linalg.norm(segments.mean(axis=1) - point, axis=1) < reach
    p, q = (segments[near] - point).swapaxes(0, 1)
    turn = np.arctan2(np.cross(p, q) @ normal, (p * q).sum(axis=1)).sum()
    if not near.any() or abs(turn - 2.0 * np.pi) > 0.1:
        return np.full(3, np.nan)
    wall, outward = walls[faces[near]], np.cross(q - p, normal)
    # outward has the length of the segment, as the integral wants it; n tilts by d, and h = -(x - p) . d
    steep = (wall * outward).sum(axis=1)
    slide = np.divide((outward**2).sum(axis=1) * (wall @ normal), steep, out=np.zeros_like(steep), where=steep != 0)
    return np.asarray(slide @ (0.5 * (p + q)))
