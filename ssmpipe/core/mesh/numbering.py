"""A numbering of vertices and faces that depends on the surface alone, not on its pose, its side or the order in the file."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.operators import face_areas, face_to_vertex
from ssmpipe.core.mesh.trimesh import TriMesh

_SAME = 1e-11
"""Values nearer to each other than this share of their largest are equal but for rounding [-]."""


def canonical_order(mesh: TriMesh) -> tuple[Ints, Ints]:
    """Return the order of vertices by their distance to the centroid of the surface, and the order of faces by their corners.

    Vertices equally far but for rounding are ordered by the area of the faces around them, and after that, as on symmetric
    shapes, stay in the order in which they are. Faces are ordered by their corners in the new numbering, the nearest first, whichever
    way they are wound. Rigid motions, mirroring and shuffling change neither order, unless rounding swaps two neighbours; coordinates
    rounded to single precision do swap some.

    Parameters
    ----------
    mesh : TriMesh

    Returns
    -------
    vertices : (n_vertices,) int64
        Index in ``mesh`` of each vertex in the new order.
    faces : (n_faces,) int64
        Index in ``mesh`` of each face in the new order.

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0.0], [3, 2, 0]])
    >>> vertices, faces = canonical_order(TriMesh(corners, np.array([[0, 1, 2], [2, 1, 3]])))
    >>> vertices.tolist(), faces.tolist()
    ([1, 2, 3, 0], [1, 0])
    """
    weights = face_areas(mesh)
    if not weights.any():
        weights = np.ones(mesh.n_faces)
    center = weights @ mesh.vertices[mesh.faces].mean(axis=1) / weights.sum()
    distance = _level(np.linalg.norm(mesh.vertices - center, axis=1))
    around = _level(face_to_vertex(mesh) @ weights)
    vertices = np.lexsort((around, distance))
    corners = np.sort(_inverse(vertices)[mesh.faces], axis=1)
    return vertices, np.lexsort((corners[:, 2], corners[:, 1], corners[:, 0]))


def canonical(mesh: TriMesh) -> tuple[TriMesh, bool]:
    """Return the mesh numbered by :func:`canonical_order`, and whether its faces had to be turned over.

    Every face begins with its lowest corner, and the first face rises; where it does not, all faces are wound the other way. So
    a surface and its mirror image get the same faces.

    Examples
    --------
    >>> mesh = TriMesh(np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> mirrored = TriMesh(mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1])
    >>> [(m.faces.tolist(), turned) for m, turned in map(canonical, (mesh, mirrored))]
    [([[0, 1, 2]], True), ([[0, 1, 2]], False)]
    """
    order, face_order = canonical_order(mesh)
    faces = _inverse(order)[mesh.faces[face_order]]
    turn = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    turned = bool(faces[0, 1] > faces[0, 2])
    return TriMesh(mesh.vertices[order], faces[:, [0, 2, 1]] if turned else faces), turned


def _level(values: Floats) -> Ints:
    """Return the rank of each value; values that differ by rounding only have the same."""
    order = np.argsort(values, kind="stable")
    rank = np.empty(len(values), dtype=np.int64)
    ascending = values[order]
    rank[order] = np.cumsum(np.diff(ascending, prepend=ascending[:1]) > _SAME * ascending[-1])
    return rank


def _inverse(order: Ints) -> Ints:
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    return inverse
