"""Trivial correspondences to beat: closest point after pairwise rigid or affine iterative closest point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.procrustes import rotation_between
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh


def register(source: TriMesh, target: TriMesh, *, affine: bool, n_iterations: int = 80) -> np.ndarray:
    """Return the (4, 4) matrix of an ICP from roughly aligned meshes; symmetric: both surfaces look for partners."""
    rng = np.random.default_rng(0)
    a = source.vertices[rng.permutation(source.n_vertices)[:3000]]
    b = target.vertices[rng.permutation(target.n_vertices)[:3000]]
    tree_b = cKDTree(target.vertices)
    matrix = np.eye(4)
    for k in range(n_iterations):
        moved = a @ matrix[:3, :3].T + matrix[:3, 3]
        forward = target.vertices[tree_b.query(moved)[1]]
        whole = source.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        backward = source.vertices[cKDTree(whole).query(b)[1]]
        x, y = np.concatenate([a, backward]), np.concatenate([forward, b])
        if affine and k >= 20:
            solution = np.linalg.lstsq(np.c_[x, np.ones(len(x))], y, rcond=None)[0]
            matrix = np.vstack([solution.T, [0, 0, 0, 1]])
        else:
            xm, ym = x.mean(axis=0), y.mean(axis=0)
            rotation = rotation_between(x - xm, y - ym, np.ones(len(x)))
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation, ym - rotation @ xm
    return matrix


def closest_point_transfer(
    meshes: Sequence[TriMesh], landmarks: Sequence[Mapping[str, np.ndarray]], *, affine: bool, max_distance: float = 8.0
) -> dict[str, np.ndarray]:
    """Return per landmark the transfer errors [mm] over all ordered pairs."""
    on_surface = []
    for mesh, marks in zip(meshes, landmarks, strict=True):
        near = point_to_mesh(np.array(list(marks.values())), mesh)[0]
        on_surface.append({name for name, d in zip(marks, near, strict=True) if d <= max_distance})
    errors: dict[str, list[float]] = {}
    for i, source in enumerate(meshes):
        for j, target in enumerate(meshes):
            names = sorted(on_surface[i] & on_surface[j])
            if i == j or not names:
                continue
            matrix = register(source, target, affine=affine)
            carried = np.array([landmarks[i][n] for n in names]) @ matrix[:3, :3].T + matrix[:3, 3]
            _, face, weights = point_to_mesh(carried, target)
            place = np.einsum("nk,nkd->nd", weights, target.vertices[target.faces[face]])
            for name, p in zip(names, place, strict=True):
                errors.setdefault(name, []).append(float(np.linalg.norm(p - landmarks[j][name])))
    return {name: np.array(values) for name, values in sorted(errors.items())}
