"""Where the poles of a cone or of a closed surface lie, and the vertices made for them."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import area, face_areas, face_to_vertex
from ssmpipe.core.mesh.symmetric import factorized, solve
from ssmpipe.core.mesh.topology import boundary_loops, split_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.weights import neighbour_weights


def exit_time(mesh: TriMesh, source: Ints) -> Floats:
    """Return the mean time after which a random walk on the surface reaches the source, (n_vertices,) [mm^2].

    It solves ``laplacian t = -1`` with t = 0 on the source: a distance that depends on the whole surface and not on one path, so
    that noise hardly moves its maximum.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> strip = tube(height=2.0, n_along=21)
    >>> rims = np.flatnonzero(abs(strip.vertices[:, 2] - 1.0) > 0.999)
    >>> round(float(exit_time(strip, rims).max()), 3)  # z (2 - z) / 2 at z = 1
    0.5
    """
    stiffness, mass = _operators(mesh)
    free = np.setdiff1d(np.unique(mesh.faces), source)
    time = np.zeros(mesh.n_vertices)
    time[free] = solve(stiffness[free][:, free], mass[free])
    return time


def longest_axis_mode(mesh: TriMesh) -> tuple[Floats, float]:
    """Return the slowest vibration of the surface, (n_vertices,), and by what factor the next one is faster.

    The first eigenfunction of the Laplace-Beltrami operator changes its sign once, along the longest way over the surface; it is
    largest at the ends of that way. A factor near one means that there is no longest way, as on a sphere.
    """
    stiffness, mass = _operators(mesh)
    used = np.unique(mesh.faces)
    start = mesh.vertices[used] @ np.array([1.0, 0.7, 0.4])
    stiffness, lumped, shift = stiffness[used][:, used], sparse.diags(mass[used]).tocsc(), -1e-3 / area(mesh)
    inverse = LinearOperator(stiffness.shape, factorized(stiffness - shift * lumped).solve, dtype=np.float64)
    values, vectors = eigsh(stiffness, k=3, M=lumped, sigma=shift, v0=start, OPinv=inverse)
    order = np.argsort(values)
    mode = np.zeros(mesh.n_vertices)
    mode[used] = vectors[:, order[1]]
    return mode, float(values[order[2]] / values[order[1]])


def smooth_maximum(mesh: TriMesh, values: Floats, reach: float = 0.12) -> Floats:
    """Return the place of the largest value on the surface, (3,) [mm], between the vertices.

    A quadratic function is fitted around the largest vertex in its tangent plane, within ``reach`` times the radius of a disk of
    the same area; so neither the triangulation nor a single vertex decides.
    """
    top = int(np.argmax(values))
    center = mesh.vertices[top]
    radius = reach * np.sqrt(area(mesh) / np.pi)
    away = mesh.vertices - center
    near = np.flatnonzero((np.linalg.norm(away, axis=1) < radius) & np.isin(np.arange(len(away)), mesh.faces))
    if len(near) < 10:
        return center
    axes = np.linalg.svd(away[near] - away[near].mean(axis=0), full_matrices=False)[2][:2]
    x, y = (away[near] @ axes.T / radius).T
    terms = np.column_stack([np.ones(len(x)), x, y, 0.5 * x**2, x * y, 0.5 * y**2])
    # what lies near counts more
    weight = np.sqrt(np.maximum(1.0 - x**2 - y**2, 1e-3))
    c = np.linalg.lstsq(terms * weight[:, None], values[near] * weight, rcond=None)[0]
    hessian = np.array([[c[3], c[4]], [c[4], c[5]]])
    if not (np.linalg.eigvalsh(hessian) < 0).all():
        return center
    place = -np.linalg.solve(hessian, c[1:3])
    if not np.linalg.norm(place) < 0.8:
        return center
    return nearest_place(mesh, center + radius * place @ axes)


def nearest_place(mesh: TriMesh, point: Floats) -> Floats:
    """Return the nearest place on the surface, (3,) [mm]."""
    _, face, weights = point_to_mesh(np.asarray(point, dtype=np.float64)[None], mesh)
    return np.asarray(weights[0] @ mesh.vertices[mesh.faces[face[0]]])


def apex_of(mesh: TriMesh) -> Floats:
    """Return the place that is farthest from the rim of a cap, (3,) [mm]: the maximum of :func:`exit_time`.

    On a proximal femur it lies on the head.
    """
    return smooth_maximum(mesh, exit_time(mesh, np.concatenate(boundary_loops(mesh.faces))))


def ends_of(mesh: TriMesh, direction: Floats) -> tuple[Floats, Floats, float, float]:
    """Return antapex and apex of a closed surface, (3,) each [mm]: the ends of its longest way.

    Parameters
    ----------
    mesh : TriMesh
        Closed.
    direction : (3,) float64
        In the frame of the aligned cohort; the apex is the end that lies farther along it.

    Returns
    -------
    antapex, apex : (3,) float64
    factor : float
        See :func:`longest_axis_mode`; below about 1.1 the ends are arbitrary.
    cosine : float
        Between the direction and the line from antapex to apex; near zero their order is arbitrary.
    """
    mode, factor = longest_axis_mode(mesh)
    ends = [smooth_maximum(mesh, sign * mode) for sign in (-1.0, 1.0)]
    unit = direction / np.linalg.norm(direction)
    line = ends[1] - ends[0]
    cosine = float(line @ unit / np.linalg.norm(line))
    antapex, apex = ends if cosine >= 0 else ends[::-1]
    return antapex, apex, factor, abs(cosine)


def insert_point(mesh: TriMesh, point: Floats, snap: float = 0.1) -> tuple[TriMesh, int]:
    """Make the place of the surface that is nearest to a point a vertex.

    Parameters
    ----------
    mesh : TriMesh
    point : (3,) float64
    snap : float
        Barycentric coordinates below this share count as zero: the place then lies on an edge or is a vertex.

    Returns
    -------
    mesh : TriMesh
        With more vertices at the end, unless the place is a vertex; the surface is the same.
    vertex : int

    Raises
    ------
    GeometryError
        If the place lies on the boundary.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> mesh, vertex = insert_point(flat_square(3), np.array([0.3, 0.1, 5.0]))
    >>> mesh.vertices[vertex]
    array([0.3, 0.1, 0. ])
    """
    _, face, weights = point_to_mesh(np.asarray(point, dtype=np.float64)[None], mesh)
    corners, share = mesh.faces[face[0]], np.where(weights[0] < snap, 0.0, weights[0])
    share = share / share.sum()
    edges = unique_edges(mesh.faces)
    rim = np.unique(edges.vertices[edges.n_faces == 1])
    inside = np.flatnonzero(share)
    if np.isin(corners[inside], rim).all() and (
        len(inside) == 1
        or (len(inside) == 2 and edges.n_faces[(edges.vertices == np.sort(corners[inside])).all(axis=1)] == 1)
    ):
        x, y, z = point
        raise GeometryError(
            f"the pole at ({x:.1f}, {y:.1f}, {z:.1f}) mm falls on the boundary of the surface",
            "choose a landmark inside the surface for the role apex",
        )
    if len(inside) == 1:
        return mesh, int(corners[inside[0]])
    place = share @ mesh.vertices[corners]
    n = mesh.n_vertices
    if len(inside) == 2:
        return _without_wide_angles(split_edges(mesh, corners[inside][None], place[None]), n), n
    a, b, c = corners
    faces = np.vstack([np.delete(mesh.faces, face[0], axis=0), [[a, b, n], [b, c, n], [c, a, n]]])
    return _without_wide_angles(TriMesh(np.vstack([mesh.vertices, place]), faces), n), n


def _without_wide_angles(mesh: TriMesh, vertex: int) -> TriMesh:
    """Divide the faces with more than a right angle at a vertex, below the vertex: wide angles make negative weights."""
    at, corner = np.nonzero(mesh.faces == vertex)
    link = np.column_stack([mesh.faces[at, (corner + k) % 3] for k in (1, 2)])
    start, end = mesh.vertices[link[:, 0]], mesh.vertices[link[:, 1]]
    center = mesh.vertices[vertex]
    wide = np.einsum("ij,ij->i", start - center, end - center) < 0
    side = end - start
    foot = np.clip(np.einsum("ij,ij->i", center - start, side) / np.einsum("ij,ij->i", side, side), 0.25, 0.75)
    return split_edges(mesh, link[wide], (start + foot[:, None] * side)[wide])


def _operators(mesh: TriMesh) -> tuple[sparse.csr_matrix, Floats]:
    """Return the cotangent stiffness matrix and the lumped mass (a third of the faces' areas)."""
    weights = neighbour_weights(mesh, "harmonic")
    stiffness = sparse.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights
    mass = face_to_vertex(mesh) @ (face_areas(mesh) / 3.0)
    return sparse.csr_matrix(stiffness), np.asarray(mass)
