"""Close holes of a surface with patches that follow another surface, such as the one that a model expects there."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import signed_projection
from ssmpipe.core.mesh.operators import area, edge_lengths, mean_edge_length, vertex_normals
from ssmpipe.core.mesh.topology import split_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.filling import fill
from ssmpipe.core.repair.holes import delaunay_flips
from ssmpipe.core.repair.patch_fairing import fading, relaxed

_ROUNDS = 120
_FACES = 1000
_BLEND = 4.0
"""Edges over which a patch goes over from the rim to the other surface."""


def fill_towards(mesh: TriMesh, loops: list[Ints], target: TriMesh) -> tuple[TriMesh, list[slice]]:
    """Close boundary loops with patches that lie on ``target`` and blend into the rim.

    Each patch begins flat and grows along its normals until it meets the target, its triangles kept even and of the size of those of the
    mesh. What is left between the rim and the target fades within a few edges. The vertices of the mesh stay to the bit.

    Parameters
    ----------
    mesh : TriMesh
        Oriented and manifold.
    loops : list of (n,) int64
        As :func:`ssmpipe.core.mesh.topology.boundary_loops` gives them; those to close.
    target : TriMesh
        In the same frame, wound outward; it should have no opening where a patch has to go.

    Returns
    -------
    mesh : TriMesh
        Old vertices and faces first.
    patches : list of slice
        Which vertices are new, for each loop.

    Raises
    ------
    TopologyError
        If loops touch.
    GeometryError
        If a hole cannot be closed by a patch without folds, or a patch grows past the size of the target.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> from ssmpipe.core.mesh.topology import boundary_loops
    >>> from ssmpipe.core.repair.trimming import trim
    >>> ball = sphere(10.0, 3)
    >>> cup = trim(ball, np.array([0, 0, 5.0]), np.array([0, 0, 1.0]))
    >>> full, (new,) = fill_towards(cup, boundary_loops(cup.faces), ball)
    >>> boundary_loops(full.faces), bool(abs(np.linalg.norm(full.vertices[new], axis=1) - 10.0).max() < 0.2)
    ([], True)
    """
    flat, records = fill(mesh, loops, method="membrane")
    vertices, faces, slices = [mesh.vertices], [mesh.faces], []
    wanted, first, n = mean_edge_length(mesh), mesh.n_faces, mesh.n_vertices
    for record in records:
        triangles = flat.faces[first : first + record.n_faces]
        first += record.n_faces
        used = np.unique(triangles)
        rim = used[used < mesh.n_vertices]
        local = np.searchsorted(used, triangles)
        grown, cells = _grown(flat.vertices[used], local, len(rim), target, wanted)
        number = np.r_[rim, n + np.arange(len(grown) - len(rim))]
        vertices.append(grown[len(rim) :])
        faces.append(number[cells])
        slices.append(slice(n, n + len(grown) - len(rim)))
        n += len(grown) - len(rim)
    return TriMesh(np.vstack(vertices), np.vstack(faces)), slices


def _grown(vertices: Floats, triangles: Ints, n_rim: int, target: TriMesh, wanted: float) -> tuple[Floats, Ints]:
    """Return the vertices of a patch, rim first, and its triangles when it has met the target."""
    rim = vertices[:n_rim].copy()
    most = max(_FACES, 3 * len(triangles)) + 3.0 * area(target) / (0.4 * wanted**2)
    for k in range(_ROUNDS):
        if len(vertices) > n_rim:
            nearest, away = signed_projection(vertices[n_rim:], target)
            normal = vertex_normals(TriMesh(vertices, triangles))[n_rim:]
            step = np.clip(-away, -0.7 * wanted, 0.7 * wanted)[:, None] * normal
            near = np.abs(away) < 0.7 * wanted
            vertices[n_rim:] += np.where(near[:, None], nearest - vertices[n_rim:], step)
            vertices = relaxed(vertices, triangles, n_rim, 3)
            if k > 8 and np.percentile(np.abs(away), 98) < 0.2 * wanted:
                break
        if k % 4 == 3:
            vertices, triangles = _refined(vertices, triangles, n_rim, 1.6 * wanted)
            if len(triangles) > most:
                raise GeometryError(
                    f"the patch for a hole of {n_rim} edges does not come to rest on the surface that it is to follow",
                    "cut the scan so that what is missing is one piece",
                )
            triangles = delaunay_flips(vertices, triangles, n_rim)
    for _ in range(3):
        vertices = relaxed(vertices, triangles, n_rim, 3)
        vertices[n_rim:] = signed_projection(vertices[n_rim:], target)[0]
        triangles = delaunay_flips(vertices, triangles, n_rim)
    left = rim - signed_projection(rim, target)[0]
    vertices += fading(triangles, left, len(vertices), _BLEND)
    vertices[:n_rim] = rim
    return vertices, triangles


def _refined(vertices: Floats, triangles: Ints, n_rim: int, longest: float) -> tuple[Floats, Ints]:
    """Divide edges longer than ``longest``, those along the rim left out."""
    mesh = TriMesh(vertices, triangles)
    edges = unique_edges(triangles)
    inner = edges.vertices[edges.n_faces == 2]
    inner = inner[edge_lengths(mesh, inner) > longest]
    if not len(inner):
        return vertices, triangles
    finer = split_edges(mesh, inner, mesh.vertices[inner].mean(axis=1))
    return np.array(finer.vertices), finer.faces
