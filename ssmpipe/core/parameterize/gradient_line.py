"""Trace a line of steepest ascent of a function over the faces of a surface."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import face_to_vertex, face_vectors
from ssmpipe.core.mesh.topology import face_neighbours
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.geodesic import SurfacePath

SNAP = 0.02
"""Where the line leaves a face nearer than this share of the side to a higher vertex it goes on from the vertex [-]."""


def gradient_line(mesh: TriMesh, values: Floats, start: int) -> SurfacePath:
    """Follow the gradient of a function that is linear in every face, uphill from a vertex (Li 2015, section 5.2.4).

    Within a face the line is straight. Where the functions of both faces at an edge rise towards the edge, the line follows it to
    its higher end. From a vertex it takes the steepest of the faces around it whose gradient points into them, and of the edges.
    The function increases strictly along the line, so that the line ends and does not meet itself.

    Parameters
    ----------
    mesh : TriMesh
    values : (n_vertices,) float64
    start : int
        Vertex.

    Returns
    -------
    SurfacePath
        To the boundary or to a vertex that is higher than its neighbours.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(5)
    >>> line = gradient_line(square, square.vertices @ [1.0, 0.5, 0.0], 7)
    >>> a, b = square.vertices[line.edges[-1]]
    >>> square.vertices[7], a + line.fraction[-1] * (b - a), round(line.length, 4)
    (array([0.25, 0.5 , 0.  ]), array([1.   , 0.875, 0.   ]), 0.8385)
    """
    rise = _rise(mesh, values)
    steepness = np.sqrt(np.maximum(np.einsum("fk,fk->f", rise, values[mesh.faces]), 0.0))
    neighbour = face_neighbours(mesh.faces)
    around = face_to_vertex(mesh)

    def leave(face: int, at: Floats) -> tuple[Ints, float, int]:
        """Return the edge, the fraction on it and the side of the face where the line from ``at`` leaves it."""
        falling = rise[face] < 0
        length = np.where(falling & (at > 0), at / np.where(falling, -rise[face], 1.0), np.inf)
        k = int(np.argmin(length))
        exit_at = np.maximum(at + length[k] * rise[face], 0.0)
        side = (k + 1) % 3
        ends = mesh.faces[face, [side, (side + 1) % 3]]
        return ends, float(exit_at[(side + 1) % 3] / (exit_at[side] + exit_at[(side + 1) % 3])), side

    def from_vertex(vertex: int) -> tuple[int | None, int | None]:
        """Return the higher vertex to follow an edge to, or the face to cross; neither at a summit."""
        best, follow, cross = 0.0, None, None
        for face in around.indices[around.indptr[vertex] : around.indptr[vertex + 1]]:
            corner = int(np.flatnonzero(mesh.faces[face] == vertex)[0])
            others = [(corner + 1) % 3, (corner + 2) % 3]
            if (rise[face, others] > 0).all() and steepness[face] > best:
                best, follow, cross = float(steepness[face]), None, int(face)
            for other in mesh.faces[face, others]:
                slope = float(values[other] - values[vertex]) / float(
                    np.linalg.norm(mesh.vertices[other] - mesh.vertices[vertex])
                )
                if slope > best:
                    best, follow, cross = slope, int(other), None
        return follow, cross

    edges, fraction = [(start, start)], [0.0]
    vertex: int | None = start
    face, at, now = -1, np.zeros(3), float(values[start])
    while True:
        if vertex is not None:
            follow, cross = from_vertex(vertex)
            if follow is not None:
                edges.append((follow, follow))
                fraction.append(0.0)
                vertex, now = follow, float(values[follow])
                continue
            if cross is None:
                break
            face, at = cross, (mesh.faces[cross] == vertex).astype(np.float64)
        (a, b), t, side = leave(face, at)
        near = a if t < SNAP else b if t > 1 - SNAP else None
        if near is not None and values[near] > now:
            vertex, now = int(near), float(values[near])
            edges.append((vertex, vertex))
            fraction.append(0.0)
            continue
        t = min(max(t, 1e-6), 1 - 1e-6)
        edges.append((int(a), int(b)))
        fraction.append(t)
        now = float((1 - t) * values[a] + t * values[b])
        behind = int(neighbour[face, side])
        if behind < 0:
            break
        at = np.where(mesh.faces[behind] == a, 1 - t, np.where(mesh.faces[behind] == b, t, 0.0))
        face, vertex = behind, None
        if rise[face, int(np.argmin(at))] <= 0:
            vertex = int(a if values[a] > values[b] else b)
            now = float(values[vertex])
            edges.append((vertex, vertex))
            fraction.append(0.0)
        if len(edges) > 4 * mesh.n_faces:
            raise GeometryError("a gradient line does not end", "smooth the mesh first")
    ends = np.array(edges)
    share = np.array(fraction)
    points = mesh.vertices[ends[:, 0]] + share[:, None] * (mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]])
    return SurfacePath(ends, share, float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))


def _rise(mesh: TriMesh, values: Floats) -> Floats:
    """Return by how much the three barycentric coordinates change per unit along the gradient, (n_faces, 3).

    That is the scalar product of the gradients of each coordinate and of the function [value / mm^2].
    """
    normal = face_vectors(mesh)
    doubled = 2.0 * np.linalg.norm(normal, axis=1)
    p = mesh.vertices[mesh.faces]
    opposite = np.roll(p, -2, axis=1) - np.roll(p, -1, axis=1)
    unit = np.divide(normal, 0.5 * doubled[:, None], out=np.zeros_like(normal), where=doubled[:, None] > 0)
    slopes = np.cross(unit[:, None], opposite)
    slopes = np.divide(slopes, doubled[:, None, None], out=np.zeros_like(slopes), where=doubled[:, None, None] > 0)
    gradient = np.einsum("fkd,fk->fd", slopes, values[mesh.faces])
    return np.asarray(np.einsum("fkd,fd->fk", slopes, gradient))
