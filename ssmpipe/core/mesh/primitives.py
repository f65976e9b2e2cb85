"""Surfaces with known answers, for tests, examples and synthetic cohorts."""

from __future__ import annotations

import igl
import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.trimesh import TriMesh


def _grid(n_u: int, n_v: int, *, wrap_u: bool = False, wrap_v: bool = False) -> Ints:
    """Return two counter-clockwise triangles per cell of an ``n_u x n_v`` grid of points in row-major order."""
    cells = np.meshgrid(np.arange(n_u if wrap_u else n_u - 1), np.arange(n_v if wrap_v else n_v - 1), indexing="ij")
    i, j = (c.ravel() for c in cells)
    up, right = (i + 1) % n_u, (j + 1) % n_v
    a, b, c, d = i * n_v + j, up * n_v + j, up * n_v + right, i * n_v + right
    return np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def flat_square(n: int = 11, size: float = 1.0) -> TriMesh:
    """Return the square [0, size]^2 in the plane z = 0 with normals up, n x n vertices.

    Examples
    --------
    >>> flat_square(3).n_faces
    8
    """
    t = np.linspace(0.0, size, n)
    x, y = np.meshgrid(t, t, indexing="ij")
    return TriMesh(np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)]), _grid(n, n))


def sphere(radius: float = 1.0, subdivisions: int = 4) -> TriMesh:
    """Return a subdivided icosahedron on the sphere, normals outward, 20 * 4^subdivisions faces."""
    vertices, faces = igl.icosahedron()
    if subdivisions:
        vertices, faces = igl.upsample(vertices, faces, subdivisions)
    mesh = TriMesh(radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", a, np.cross(b, c)) > 0
    return TriMesh(mesh.vertices, np.where(outward[:, None], mesh.faces, mesh.faces[:, ::-1]))


def torus(major: float = 3.0, minor: float = 1.0, n_major: int = 48, n_minor: int = 24) -> TriMesh:
    """Return a torus about the z axis, genus 1, normals outward."""
    s = 2 * np.pi * np.arange(n_major) / n_major
    t = 2 * np.pi * np.arange(n_minor) / n_minor
    s, t = (x.ravel() for x in np.meshgrid(s, t, indexing="ij"))
    ring = major + minor * np.cos(t)
    points = np.column_stack([ring * np.cos(s), ring * np.sin(s), minor * np.sin(t)])
    return TriMesh(points, _grid(n_major, n_minor, wrap_u=True, wrap_v=True))


def tube(radius: float = 1.0, height: float = 4.0, n_around: int = 48, n_along: int = 25) -> TriMesh:
    """Return an open cylinder about the z axis from z = 0 to ``height``, two boundary loops, normals outward."""
    angle = 2 * np.pi * np.arange(n_around) / n_around
    z = np.linspace(0.0, height, n_along)
    a, z = (x.ravel() for x in np.meshgrid(angle, z, indexing="ij"))
    points = np.column_stack([radius * np.cos(a), radius * np.sin(a), z])
    return TriMesh(points, _grid(n_around, n_along, wrap_u=True))


def star_shape(subdivisions: int = 4, scale: float = 30.0) -> TriMesh:
    """Return a closed lump without any symmetry, normals outward [mm]: a sphere with a long and a few short bumps."""
    mesh = sphere(1.0, subdivisions)
    bumps: tuple[tuple[float, float, Floats], ...] = (
        (1.3, 6.0, np.array([0.1, 0.2, 1.0])),
        (0.5, 9.0, np.array([1.0, 0.3, -0.4])),
        (0.35, 12.0, np.array([-0.5, 1.0, -0.6])),
        (-0.2, 10.0, np.array([0.3, -1.0, -0.2])),
    )
    radius = np.ones(mesh.n_vertices)
    for height, sharpness, direction in bumps:
        radius += height * np.exp(sharpness * (mesh.vertices @ (direction / np.linalg.norm(direction)) - 1.0))
    return TriMesh(scale * radius[:, None] * mesh.vertices * [1.0, 0.8, 1.1], mesh.faces)
