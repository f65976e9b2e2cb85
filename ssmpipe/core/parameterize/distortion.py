"""How much a map from the square to the surface stretches, and whether it folds."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.mesh.operators import face_areas, face_to_vertex
from ssmpipe.core.mesh.trimesh import TriMesh


def signed_uv_areas(uv: Floats, faces: np.ndarray) -> Floats:
    """Return the signed areas of the triangles in the square, (n_faces,); positive when counter-clockwise."""
    e, f = uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]
    return np.asarray(0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]))


def folded(uv: Floats, faces: np.ndarray) -> Bools:
    """Return which triangles are turned over or without area in the square, (n_faces,)."""
    return signed_uv_areas(uv, faces) <= 0.0


def squared_stretch(mesh: TriMesh, uv: Floats) -> Floats:
    """Return the squared stretch of each triangle, ``(|S_u|^2 + |S_v|^2) / 2`` (Sander et al. 2001; Li 2015, eq. 4.5).

    It is the mean of the squared singular values of the Jacobian of the map from the square to the surface
    [mm^2 per unit area].

    Returns
    -------
    (n_faces,) float64
        Infinite where a triangle has no area in the square.
    """
    (u, v), p = np.moveaxis(uv[mesh.faces], 2, 0), mesh.vertices[mesh.faces]
    twice = 2.0 * signed_uv_areas(uv, mesh.faces)
    s_u = np.einsum("fkd,fk->fd", p, np.stack([v[:, 1] - v[:, 2], v[:, 2] - v[:, 0], v[:, 0] - v[:, 1]], axis=1))
    s_v = np.einsum("fkd,fk->fd", p, np.stack([u[:, 2] - u[:, 1], u[:, 0] - u[:, 2], u[:, 1] - u[:, 0]], axis=1))
    total = (s_u**2).sum(axis=1) + (s_v**2).sum(axis=1)
    return np.divide(0.5 * total, twice**2, out=np.full(len(total), np.inf), where=twice != 0)


def vertex_stretch(mesh: TriMesh, uv: Floats) -> Floats:
    """Return the area-weighted root mean square stretch of the triangles at each vertex, (n_vertices,) (eq. 4.6)."""
    areas = face_areas(mesh)
    incidence = face_to_vertex(mesh)
    total = incidence @ areas
    square = (incidence @ np.where(areas > 0, areas * squared_stretch(mesh, uv), 0.0)) / np.where(total > 0, total, 1.0)
    return np.sqrt(square)


def global_stretch(mesh: TriMesh, uv: Floats) -> float:
    """Return the L2 stretch of the whole map (eq. 4.8), normalized: 1 for a map that only scales, never less.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(5, size=40.0)
    >>> round(global_stretch(square, square.vertices[:, :2] / 40.0), 12)
    1.0
    """
    areas = face_areas(mesh)
    energy = np.where(areas > 0, areas * squared_stretch(mesh, uv), 0.0).sum()
    return float(np.sqrt(energy * np.abs(signed_uv_areas(uv, mesh.faces)).sum()) / areas.sum())
