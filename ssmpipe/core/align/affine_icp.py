"""Affine registration of one surface to another, which carries places of a reference to every shape."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.align.icp import PointSurface, pairs, refine
from ssmpipe.core.align.rigid import homogeneous
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.trimesh import TriMesh


def affine_onto(
    source: TriMesh, target: TriMesh, *, n_points: int = 3000, n_iterations: int = 60, ridge: float = 1e-3
) -> Floats:
    """Return the affine map, (4, 4), that brings an aligned surface closest to another one.

    The size is adapted first (:func:`ssmpipe.core.align.icp.refine`), then all twelve numbers, by the same symmetric
    point-to-plane distances (Chen and Medioni 1992).

    Parameters
    ----------
    source, target : TriMesh
        In a common frame, roughly aligned.
    n_points : int
        Per surface.
    n_iterations : int
    ridge : float
        Pull towards a step without deformation, relative to the mean diagonal of the normal equations; holds what the distances do
        not determine, such as the shear of a cylinder.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import star_shape
    >>> lump = star_shape(3)
    >>> stretch = np.diag([1.1, 0.9, 1.0, 1.0])
    >>> found = affine_onto(lump, TriMesh(lump.vertices @ stretch[:3, :3], lump.faces))
    >>> bool(np.allclose(found, stretch, atol=0.02))
    True
    """
    a, b = PointSurface.of(source, n_points), PointSurface.of(target, n_points)
    center = b.points.mean(axis=0)
    size = float(np.sqrt(((b.points - center) ** 2).sum(axis=1).mean()))
    own = a.points.mean(axis=0)
    factor = size / float(np.sqrt(((a.points - own) ** 2).sum(axis=1).mean()))
    matrix = refine(a, b, homogeneous(factor * np.eye(3), center - factor * own), scaled=True)[0]
    best, lowest, lowest_at = matrix, np.inf, 0
    for iteration in range(n_iterations):
        points, goals, normals = pairs(a, b, matrix)
        residual = np.einsum("ij,ij->i", goals - points, normals)
        now = float(residual @ residual)
        if now < lowest:
            best, lowest_at = matrix, iteration if now < (1.0 - 1e-3) * lowest else lowest_at
            lowest = now
        if iteration - lowest_at >= 6:
            break
        arms = np.hstack([(points - center) / size, np.ones((len(points), 1))])
        rows = (normals[:, :, None] * arms[:, None, :]).reshape(len(points), 12)
        system = rows.T @ rows
        pull = ridge * np.trace(system) / 12.0 * np.eye(12)
        step = np.linalg.solve(system + pull, rows.T @ residual).reshape(3, 4)
        linear = np.eye(3) + step[:, :3] / size
        matrix = homogeneous(linear, center + step[:, 3] - linear @ center) @ matrix
    return best
