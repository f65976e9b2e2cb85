"""Ways to disturb a mesh without changing the surface, and to damage it."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from ssmpipe.core.align.rigid import homogeneous
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.trimesh import TriMesh


def random_motion(rng: np.random.Generator, shift: float = 50.0) -> np.ndarray:
    """Return a proper rigid motion (4, 4)."""
    quaternion = rng.normal(size=4)
    return homogeneous(
        Rotation.from_quat(quaternion / np.linalg.norm(quaternion)).as_matrix(), shift * rng.normal(size=3)
    )


def relabeled(mesh: TriMesh, rng: np.random.Generator) -> tuple[TriMesh, np.ndarray]:
    """Return the mesh with shuffled vertices and faces, and the new index of every old vertex."""
    order = rng.permutation(mesh.n_vertices)
    new = np.argsort(order)
    faces = new[mesh.faces][rng.permutation(mesh.n_faces)]
    return TriMesh(mesh.vertices[order], faces), new


def joined(*meshes: TriMesh) -> TriMesh:
    """Put meshes into one, without merging vertices."""
    offsets = np.cumsum([0] + [m.n_vertices for m in meshes[:-1]])
    faces = np.vstack([m.faces + o for m, o in zip(meshes, offsets, strict=True)])
    return TriMesh(np.vstack([m.vertices for m in meshes]), faces)


def soup(mesh: TriMesh) -> TriMesh:
    """Give every face its own three vertices, as an STL file does."""
    return TriMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * mesh.n_faces).reshape(-1, 3))


def noisy(mesh: TriMesh, rng: np.random.Generator, sigma: float) -> TriMesh:
    """Move vertices at random."""
    return TriMesh(mesh.vertices + sigma * rng.normal(size=mesh.vertices.shape), mesh.faces)


def with_caps(mesh: TriMesh, number: int, seed: int = 0, share: tuple[float, float] = (0.2, 0.8)) -> TriMesh:
    """Put vertices on sides of faces, and a face without area between each of them and its side; one on another, too."""
    rng = np.random.default_rng(seed)
    vertices, faces = list(mesh.vertices), [tuple(face) for face in mesh.faces]
    for k in rng.integers(0, len(faces), number):
        a, b, c = np.roll(faces[k], rng.integers(3))
        t = rng.uniform(*share)
        new = len(vertices)
        vertices.append((1.0 - t) * vertices[a] + t * vertices[b])
        faces[k] = (a, new, c)
        faces += [(new, b, c), (a, b, new)]
    return TriMesh(np.array(vertices), np.array(faces))


def box(low: tuple[float, float, float], size: float = 1.0) -> TriMesh:
    """Return a cube of twelve triangles, outward."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return TriMesh(np.array(low) + size * corners, np.array(faces))


def bent_tube(n_around: int = 32, n_along: int = 41, *, turn: float = 2.0, bump: float = 0.4, seed: int = 0) -> TriMesh:
    """Return a tube around an arc in the plane y = 0, radius 4 to 3 mm, with a bump; inner vertices jittered."""
    rng = np.random.default_rng(seed)
    mesh = tube(1.0, 1.0, n_around, n_along)
    angle, t = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]), mesh.vertices[:, 2].copy()
    inside = (t > 0) & (t < 1)
    angle[inside] += rng.uniform(-0.3, 0.3, inside.sum()) * 2 * np.pi / n_around
    t[inside] += rng.uniform(-0.3, 0.3, inside.sum()) / n_along
    radius = 4.0 - t + bump * np.exp(-((np.cos(angle) - 1.0) ** 2) / 0.5 - (t - 0.4) ** 2 / 0.02)
    around = 15.0 + radius * np.cos(angle)
    points = np.column_stack([around * np.cos(turn * t), radius * np.sin(angle), around * np.sin(turn * t)])
    return outward(TriMesh(points, mesh.faces))


def outward(mesh: TriMesh) -> TriMesh:
    """Turn the faces of a bent tube around if they look inwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    center = (a + b + c) / 3
    along = np.arctan2(center[:, 2], center[:, 0])
    axis = 15.0 * np.column_stack([np.cos(along), np.zeros(len(along)), np.sin(along)])
    inwards = np.einsum("ij,ij->i", normal, center - axis).sum() < 0
    return TriMesh(mesh.vertices, mesh.faces[:, ::-1] if inwards else mesh.faces)


def implicit_surface(function: Callable[[np.ndarray], np.ndarray], reach: float, n: int) -> TriMesh:
    """Return where a function of points (k, 3) vanishes within a cube about the origin, positive outside; n^3 cells."""
    t = np.linspace(-reach, reach, n)
    grid = np.stack(np.meshgrid(t, t, t, indexing="ij"), axis=-1).reshape(-1, 3)
    vertices, faces, _ = igl.marching_cubes(function(grid), grid[:, [0, 1, 2]], n, n, n, 0.0)
    return TriMesh(vertices, faces)


def aortic_root(
    size: float = 3.0, start: float = -6.0, end: float = 60.0, *, waves: int = 3, width: float = 14.0
) -> TriMesh:
    """Return a straight tube along z whose sections have lobes around z = 12: their wave has half its size at 5 and 19 [mm]."""
    plain = tube(1.0, end - start, 72, int((end - start) / 0.8))
    angle = np.arctan2(plain.vertices[:, 1], plain.vertices[:, 0])
    z = plain.vertices[:, 2] + start
    bell = np.exp(-np.log(2.0) * ((z - 12.0) / 7.0) ** 2)
    radius = width + size * bell * (1.0 + 0.6 * np.cos(waves * angle)) + 1.5 / (1.0 + np.exp(-(z - 32.0) / 4.0))
    return TriMesh(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z]), plain.faces)
