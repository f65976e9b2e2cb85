"""Measures and averages on triangle meshes: areas, normals, volume, adjacency."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.trimesh import TriMesh


def face_vectors(mesh: TriMesh) -> Floats:
    """Return the area vectors of the faces: half the cross product of two edges, (n_faces, 3) [mm^2]."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def face_areas(mesh: TriMesh) -> Floats:
    """Return the areas of the faces, (n_faces,) [mm^2].

    Examples
    --------
    >>> face_areas(TriMesh(np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]]), np.array([[0, 1, 2]])))
    array([2.])
    """
    return np.linalg.norm(face_vectors(mesh), axis=1)


def face_normals(mesh: TriMesh) -> Floats:
    """Return unit normals of the faces, (n_faces, 3); zero where a face has no area."""
    return _unit(face_vectors(mesh))


def vertex_normals(mesh: TriMesh) -> Floats:
    """Return area-weighted unit normals at the vertices, (n_vertices, 3)."""
    return _unit(face_to_vertex(mesh) @ face_vectors(mesh))


def face_to_vertex(mesh: TriMesh) -> sparse.csr_matrix:
    """Return the (n_vertices, n_faces) incidence matrix: one where the face has the vertex."""
    rows = mesh.faces.ravel()
    columns = np.repeat(np.arange(mesh.n_faces), 3)
    return sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(mesh.n_vertices, mesh.n_faces))


def area(mesh: TriMesh) -> float:
    """Return the surface area [mm^2]."""
    return float(face_areas(mesh).sum())


def volume(mesh: TriMesh) -> float:
    """Return the signed volume [mm^3] below the faces, seen from the surface's centroid.

    Positive for closed outward surfaces. For an open surface it is the volume of the cone over it with the apex there.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - surface_centroid(mesh) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def surface_centroid(mesh: TriMesh) -> Floats:
    """Return the centroid of the surface (not of the vertices, whose density varies), (3,) [mm]."""
    weights = face_areas(mesh)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    return np.asarray(weights @ centers / weights.sum())


def surface_covariance(mesh: TriMesh) -> Floats:
    """Return the (3, 3) covariance of the surface about its centroid [mm^2], exact for the piecewise flat surface.

    Uses the midpoint rule on the three edges of each face, which integrates quadratics exactly.
    """
    weights = face_areas(mesh)
    centroid = surface_centroid(mesh)
    corners = mesh.vertices[mesh.faces] - centroid
    covariance = np.zeros((3, 3))
    for k in range(3):
        middle = 0.5 * (corners[:, k] + corners[:, (k + 1) % 3])
        covariance += (middle * weights[:, None]).T @ middle / 3.0
    return covariance / weights.sum()


def edge_lengths(mesh: TriMesh, edges: Ints) -> Floats:
    """Return the lengths of ``edges`` (n, 2), (n,) [mm]."""
    return np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)


def mean_edge_length(mesh: TriMesh) -> float:
    """Return the mean length of the faces' sides [mm]."""
    corners = mesh.vertices[mesh.faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def adjacency(mesh: TriMesh) -> sparse.csr_matrix:
    """Return the (n_vertices, n_vertices) matrix with a one for every edge, symmetric, sorted indices."""
    i, j = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    n = mesh.n_vertices
    matrix = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n))
    matrix.sum_duplicates()
    matrix.data[:] = 1.0
    return matrix


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
