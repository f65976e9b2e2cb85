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
    distance = np.linalg.norm(mesh.vertices - center, axis=1)
    vertices = np.argsort(distance, kind="stable")
    level = np.empty(mesh.n_vertices, dtype=np.int64)
    level[vertices] = _levels(distance[vertices])
    if level.max() + 1 < mesh.n_vertices:
        around = face_to_vertex(mesh) @ weights
        order = np.argsort(around, kind="stable")
        second = np.empty(mesh.n_vertices, dtype=np.int64)
        second[order] = _levels(around[order])
        vertices = np.lexsort((second, level))
    first, middle, last = np.sort(_inverse(vertices)[mesh.faces], axis=1).T
    if mesh.n_vertices < 2_000_000:  # one number for all three, which is faster to sort
        return vertices, np.argsort((first * mesh.n_vertices + middle) * mesh.n_vertices + last, kind="stable")
    return vertices, np.lexsort((last, middle, first))


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


def _levels(ascending: Floats) -> Ints:
    """Number rising values; those that differ by rounding only get the same number."""
    return np.cumsum(np.diff(ascending, prepend=ascending[:1]) > _SAME * ascending[-1])


def _inverse(order: Ints) -> Ints:
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    return inverse
