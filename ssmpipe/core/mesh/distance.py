"""Distances from points to surfaces, and how far two surfaces are apart."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.numbering import canonical_order
from ssmpipe.core.mesh.operators import face_areas, face_normals
from ssmpipe.core.mesh.trimesh import TriMesh


def point_to_mesh(points: Floats, mesh: TriMesh) -> tuple[Floats, Ints, Floats]:
    """Project points to the nearest place on a mesh (AABB tree of libigl).

    Parameters
    ----------
    points : (n, 3) float64
        Query points [mm].
    mesh : TriMesh

    Returns
    -------
    distances : (n,) float64
        Euclidean, unsigned [mm].
    face_index : (n,) int64
    barycentric : (n, 3) float64
        Coordinates of the nearest place in its face; not negative, sum one.

    Examples
    --------
    >>> flat = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> distance, face, weights = point_to_mesh(np.array([[0.25, 0.25, 2.0]]), flat)
    >>> distance, face, weights
    (array([2.]), array([0]), array([[0.5 , 0.25, 0.25]]))
    """
    query = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    squared, face, nearest = igl.point_mesh_squared_distance(query, mesh.vertices, mesh.faces)
    face = np.asarray(face, dtype=np.int64).ravel()
    return (
        np.sqrt(np.maximum(squared, 0.0)).ravel(),
        face,
        barycentric_coordinates(nearest, mesh.vertices[mesh.faces[face]]),
    )


def signed_point_to_mesh(points: Floats, mesh: TriMesh) -> Floats:
    """Return the distance of points to a mesh, positive on the side that the normal of the nearest face points to [mm].

    Parameters
    ----------
    points : (n, 3) float64
    mesh : TriMesh
        Open or closed; faces wound outward.

    Examples
    --------
    >>> flat = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> signed_point_to_mesh(np.array([[0.25, 0.25, -2.0], [0.25, 0.25, 1.0]]), flat)
    array([-2.,  1.])
    """
    return signed_projection(points, mesh)[1]


def signed_projection(points: Floats, mesh: TriMesh) -> tuple[Floats, Floats]:
    """Return the nearest places on a mesh, (n, 3), and the distances of the points as :func:`signed_point_to_mesh` has them [mm].

    Examples
    --------
    >>> flat = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> signed_projection(np.array([[0.25, 0.25, -2.0]]), flat)
    (array([[0.25, 0.25, 0.  ]]), array([-2.]))
    """
    distance, face, weights = point_to_mesh(points, mesh)
    nearest = interpolate(mesh.vertices, mesh, face, weights)
    side = np.einsum("ij,ij->i", points - nearest, face_normals(mesh)[face])
    return nearest, np.where(side < 0, -distance, distance)


def barycentric_coordinates(points: Floats, triangles: Floats) -> Floats:
    """Return barycentric coordinates of points in their triangles, clipped to the triangle.

    Parameters
    ----------
    points : (n, d) float64
        One point per triangle, in its plane.
    triangles : (n, 3, d) float64

    Returns
    -------
    (n, 3) float64
        For a triangle without area: coordinates along its longest side.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (np.einsum("ij,ij->i", x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
    determinant = d00 * d11 - d01 * d01
    flat = determinant <= 1e-24 * np.maximum(d00 * d11, np.finfo(float).tiny)
    safe = np.where(flat, 1.0, determinant)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    longer_ab = d00 >= d11
    v = np.where(flat, np.where(longer_ab, d20 / np.where(d00 > 0, d00, 1.0), 0.0), v)
    w = np.where(flat, np.where(longer_ab, 0.0, d21 / np.where(d11 > 0, d11, 1.0)), w)
    weights = np.clip(np.column_stack([1.0 - v - w, v, w]), 0.0, None)
    return weights / weights.sum(axis=1, keepdims=True)


def interpolate(values: Floats, mesh: TriMesh, face_index: Ints, barycentric: Floats) -> Floats:
    """Interpolate per-vertex ``values`` (n_vertices, ...) at places given by face and barycentric coordinates."""
    return np.einsum("nk,nk...->n...", barycentric, values[mesh.faces[face_index]])


def sample_surface(
    mesh: TriMesh, n_points: int, seed: int = 0, order: tuple[Ints, Ints] | None = None
) -> tuple[Floats, Ints, Floats]:
    """Spread points over a surface, uniformly in area, the same ones for the same surface and seed.

    Stratified in the cumulative area of the faces, so that the counts per region vary less than with independent draws. Faces and
    their corners are taken in their canonical order: the points move along with the surface, into its mirror image too, and do
    not depend on the order in the file.

    Parameters
    ----------
    mesh : TriMesh
    n_points : int
    seed : int
    order : (vertices, faces), optional
        What :func:`~ssmpipe.core.mesh.numbering.canonical_order` says of the mesh, for those who sample it more than once.

    Returns
    -------
    points : (n_points, 3), face_index : (n_points,), barycentric : (n_points, 3)
    """
    rng = np.random.default_rng(seed)
    vertices, faces = canonical_order(mesh) if order is None else order
    cumulative = np.cumsum(face_areas(mesh)[faces])
    at = (np.arange(n_points) + rng.random(n_points)) / n_points * cumulative[-1]
    face = faces[np.minimum(np.searchsorted(cumulative, at, side="right"), mesh.n_faces - 1)]
    r, s = np.sqrt(rng.random(n_points)), rng.random(n_points)
    rank = np.empty(mesh.n_vertices, dtype=np.int64)
    rank[vertices] = np.arange(mesh.n_vertices)
    weights = np.empty((n_points, 3))
    np.put_along_axis(
        weights, np.argsort(rank[mesh.faces[face]], axis=1), np.column_stack([1.0 - r, r * (1.0 - s), r * s]), axis=1
    )
    return np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[face]]), face, weights


@dataclass(frozen=True)
class SurfaceDeviation:
    """How far two surfaces are apart [mm]; ``a_to_b`` means points of a, distance to b.

    ``rms`` and ``percentile_95`` are over the points of both directions; ``maximum`` is the (sampled) Hausdorff distance.
    """

    rms: float
    maximum: float
    percentile_95: float
    rms_a_to_b: float
    rms_b_to_a: float
    max_a_to_b: float
    max_b_to_a: float


def surface_deviation(a: TriMesh, b: TriMesh, n_samples: int = 20000, seed: int = 0) -> SurfaceDeviation:
    """Measure how far two surfaces are apart, both ways.

    The points are the vertices of each mesh (extremes sit there) for the maximum, and ``n_samples`` points spread
    uniformly over the area for mean values, so that vertex density does not weigh.

    Parameters
    ----------
    a, b : TriMesh
    n_samples : int
        Points per mesh for root mean squares and percentiles.
    seed : int
        Same seed, same points, same figures.

    Examples
    --------
    >>> flat = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> raised = TriMesh(flat.vertices + [0, 0, 0.5], flat.faces)
    >>> surface_deviation(flat, raised, n_samples=10).rms
    0.5
    """
    spread, extreme = [], []
    for source, target in ((a, b), (b, a)):
        points = sample_surface(source, n_samples, seed)[0]
        distance = point_to_mesh(np.vstack([points, source.vertices]), target)[0]
        spread.append(distance[:n_samples])
        extreme.append(float(distance.max()))
    both = np.concatenate(spread)
    rms = [float(np.sqrt(np.mean(d**2))) for d in (both, *spread)]
    return SurfaceDeviation(
        rms[0], max(extreme), float(np.percentile(both, 95)), rms[1], rms[2], extreme[0], extreme[1]
    )
