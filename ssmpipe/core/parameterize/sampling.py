"""Read a mapped surface at a regular grid of the square."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import interpolate, point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.periodic import pole_faces
from ssmpipe.core.parameterize.seam import Seam


def sample_grid(mesh: TriMesh, uv: Floats, n_u: int, n_v: int, seam: Seam | None = None) -> Floats:
    """Return the surface points at ``(i / (n_u - 1), j / (n_v - 1))``, (n_u, n_v, 3) [mm] (Li 2015, eq. 4.9-4.10).

    With a seam the map has period 1 in u, the last row equals the first one, and the column of a pole is the pole. A face at a
    pole is a ruled patch: the place of its opposite edge at the same u, linear to the pole.

    Raises
    ------
    GeometryError
        If the map does not cover the square.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(4, size=6.0)
    >>> sample_grid(square, square.vertices[:, :2] / 6.0, 2, 3)[1, 1]
    array([6., 3., 0.])
    """
    u, v = np.linspace(0.0, 1.0, n_u), np.linspace(0.0, 1.0, n_v)
    if seam is None:
        face, weights = _locate(uv, mesh.faces, u, v)
        return interpolate(mesh.vertices, mesh, face, weights).reshape(n_u, n_v, 3)
    at, base, pole = pole_faces(mesh.faces, seam.poles)
    flat, flat_uv, number = _unrolled(mesh, uv, at, base, pole)
    face, weights = _locate(flat_uv, flat.faces, u[:-1], v)
    samples = interpolate(flat.vertices, flat, face, weights)
    # inside a patch: the place of its edge at the same u, then straight to the pole
    hit = np.flatnonzero(number[face] >= 0)
    patch, corners = number[face[hit]], flat.faces[face[hit]]
    wanted_u, wanted_v = np.repeat(u[:-1], n_v)[hit], np.tile(v, n_u - 1)[hit]
    start, end = flat_uv[corners[:, 0], 0], flat_uv[corners[:, 1], 0]
    s = np.clip((wanted_u - start) / (end - start), 0.0, 1.0)[:, None]
    (a, b), apex = base[patch].T, pole[patch]
    edge, edge_v = ((1.0 - s) * x[a] + s * x[b] for x in (mesh.vertices, uv[:, 1:]))
    t = np.clip((wanted_v[:, None] - edge_v) / (uv[apex, 1:] - edge_v), 0.0, 1.0)
    samples[hit] = (1.0 - t) * edge + t * mesh.vertices[apex]
    samples = samples.reshape(n_u - 1, n_v, 3)
    samples = np.concatenate([samples, samples[:1]])
    for vertex in seam.poles:
        samples[:, 0 if uv[vertex, 1] < 0.5 else -1] = mesh.vertices[vertex]
    return samples


def _unrolled(mesh: TriMesh, uv: Floats, at: Ints, base: Ints, pole: Ints) -> tuple[TriMesh, Floats, Ints]:
    """Return the surface repeated in u so that [0, 1] is covered, its map, and the patch of each face.

    Each face at a pole is replaced by the two halves of a patch, whose first two corners lie at the ends of its edge in u; plain
    faces have the number -1.
    """
    n, n_patches = mesh.n_vertices, len(at)
    # the corners of a patch at the pole lie straight above (or below) its edge
    lifted = n + np.arange(2 * n_patches).reshape(-1, 2)
    halves = [np.column_stack([base, lifted[:, 1]]), np.column_stack([base[:, 0], lifted[:, 1], lifted[:, 0]])]
    faces = np.concatenate([np.delete(mesh.faces, at, axis=0), *halves])
    number = np.concatenate([np.full(mesh.n_faces - n_patches, -1), np.tile(np.arange(n_patches), 2)])
    vertices = np.concatenate([mesh.vertices, np.repeat(mesh.vertices[pole], 2, axis=0)])
    corners = np.stack([uv[base, 0], np.repeat(uv[pole, 1][:, None], 2, axis=1)], axis=2).reshape(-1, 2)
    flat = np.concatenate([uv, corners])
    low, high = flat[faces, 0].min(axis=1), flat[faces, 0].max(axis=1)
    shifts = range(int(np.floor(-high.max())), int(np.ceil(1.0 - low.min())) + 1)
    seen = [(high + shift >= -1e-9) & (low + shift <= 1.0 + 1e-9) for shift in shifts]
    repeated = np.concatenate([faces[s] + k * len(flat) for k, s in enumerate(seen)])
    moved = np.concatenate([flat + [shift, 0.0] for shift in shifts])
    return (
        TriMesh(np.tile(vertices, (len(seen), 1)), repeated),
        moved,
        np.concatenate([number[s] for s in seen]),
    )


def _locate(uv: Floats, faces: Ints, u: Floats, v: Floats) -> tuple[Ints, Floats]:
    """Return the face (n,) and the barycentric coordinates (n, 3) of each point of a grid."""
    grid_u, grid_v = np.meshgrid(u, v, indexing="ij")
    wanted = np.column_stack([grid_u.ravel(), grid_v.ravel(), np.zeros(grid_u.size)])
    # libigl's own 2-D point location aborts the process; the plane z = 0 in space is safe
    gap, face, weights = point_to_mesh(wanted, TriMesh(np.column_stack([uv, np.zeros(len(uv))]), faces))
    if gap.max() > 1e-6:
        missed = int((gap > 1e-6).sum())
        raise GeometryError(
            f"{missed} of {len(wanted)} grid points lie outside the mapped surface, the farthest by {gap.max():.2g} of the square's side",
            "parameterize the surface to the whole unit square",
        )
    return face, weights
