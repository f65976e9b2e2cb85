"""Make a corresponded surface watertight: equal points become one, openings get a lid."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.mesh.trimesh import TriMesh


def weld(mesh: TriMesh) -> TriMesh:
    """Merge vertices at exactly the same place (the copies of a pole) and drop triangles that lose a corner.

    Examples
    --------
    >>> points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0.0]])
    >>> weld(TriMesh(points, np.array([[0, 1, 2], [3, 1, 4], [0, 3, 4]]))).n_faces
    2
    """
    _, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    order = np.sort(first)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    faces = rank[place.ravel()][mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return TriMesh(mesh.vertices[order], faces[whole])


def close_openings(mesh: TriMesh) -> TriMesh:
    """Close every opening by a fan from the middle of its rim; vertices that are there keep their numbers.

    The lid of a rim that is star-shaped around its middle (every planar convex cut) is free of folds.

    Returns
    -------
    TriMesh
        Watertight when ``mesh`` is a manifold.
    """
    vertices, faces = [mesh.vertices], [mesh.faces]
    for k, loop in enumerate(boundary_loops(mesh.faces)):
        following = np.roll(loop, -1)
        rim = mesh.vertices[loop]
        length = np.linalg.norm(mesh.vertices[following] - rim, axis=1)
        weight = length + np.roll(length, 1)
        vertices.append((weight / weight.sum() @ rim)[None])
        middle = np.full(len(loop), mesh.n_vertices + k)
        faces.append(np.stack([following, loop, middle], axis=1))
    return TriMesh(np.concatenate(vertices), np.concatenate(faces))
