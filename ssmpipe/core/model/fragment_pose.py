"""Where a fragment belongs on a whole surface: rigid starts from regions of its size, screened by a capped distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.rigid import apply, axis_rotations, homogeneous, rigid_fit, rotation_vector_matrix
from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.mesh.distance import sample_surface
from ssmpipe.core.mesh.operators import area, face_normals
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.remainder import farthest_first

_REGIONS = 10
_FEW, _SOME = 150, 600
_KEPT = 10
_FACING = 0.3
"""Smallest product of two unit normals that belong together."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A rigid start.

    Parameters
    ----------
    matrix : (4, 4)
        From the fragment to the surface.
    cost : float
        Root mean square distance of the fragment from the surface, capped, normals that face away at the cap [mm].
    """

    matrix: Floats
    cost: float


def place_fragment(fragment: TriMesh, whole: TriMesh, n_best: int = 3) -> list[Placed]:
    """Return the best distinct rigid poses of a fragment on a whole surface, best first.

    Principal axes of the fragment are matched with those of regions of its area all over the surface (and with the surface itself), in all
    24 ways; short runs of point-to-point ICP (Besl and McKay 1992) from the fragment to the surface screen them, the best are refined
    by point-to-plane steps. What faces away, or lies farther than the cap, does not pull.

    Parameters
    ----------
    fragment, whole : TriMesh
        No mirror image of each other; faces wound outward.
    n_best : int

    Examples
    --------
    >>> from ssmpipe.core.align.rigid import move
    >>> from ssmpipe.core.mesh.primitives import star_shape
    >>> from ssmpipe.core.repair.trimming import trim
    >>> lump = star_shape(3)
    >>> part = trim(lump, np.zeros(3), np.array([0.0, 0.0, -1.0]))
    >>> away = homogeneous(rotation_vector_matrix(np.array([0.3, 1.0, -2.0])), np.array([40.0, 0.0, 9.0]))
    >>> best = place_fragment(move(part, away), lump)[0]
    >>> bool(np.abs(apply(best.matrix @ away, part.vertices) - part.vertices).max() < 3.0)
    True
    """
    target, target_face, _ = sample_surface(whole, 4000)
    target_normals = face_normals(whole)[target_face]
    tree = cKDTree(target)
    size = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum(axis=1).mean()))
    source, face, _ = sample_surface(fragment, _SOME)
    normals = face_normals(fragment)[face]
    few = slice(None, None, _SOME // _FEW)
    share = min(1.0, area(fragment) / area(whole))
    middle, axes = _axes(source)
    starts = []
    for centre in target[farthest_first(target, _REGIONS)]:
        near = np.argsort(((target - centre) ** 2).sum(axis=1), kind="stable")[: max(50, int(share * len(target)))]
        starts += _matches(middle, axes, *_axes(target[near]))
    starts += _matches(middle, axes, *_axes(target))

    def paired(matrix: Floats, part: slice) -> tuple[Floats, Floats, Floats, Floats, Bools]:
        moved = apply(matrix, source[part])
        distance, at = tree.query(moved)
        facing = np.einsum("ij,ij->i", normals[part] @ matrix[:3, :3].T, target_normals[at]) > _FACING
        return moved, target[at], target_normals[at], distance, facing

    def cost(matrix: Floats, cap: float) -> float:
        _, _, _, distance, facing = paired(matrix, slice(None))
        return float(np.sqrt((np.where(facing, np.minimum(distance, cap), cap) ** 2).mean()))

    screened: list[tuple[float, int, Floats]] = []
    for matrix in starts:
        for k in range(14):
            moved, goals, _, distance, facing = paired(matrix, few)
            good = facing & (distance < size * max(0.15, 0.6 * 0.85**k))
            if good.sum() < 12:
                break
            matrix = rigid_fit(moved[good], goals[good]) @ matrix
        screened.append((cost(matrix, 0.1 * size), len(screened), matrix))
    screened.sort(key=lambda s: s[:2])
    refined: list[Placed] = []
    for _, _, matrix in screened[:_KEPT]:
        for _ in range(25):
            moved, goals, towards, distance, facing = paired(matrix, slice(None))
            good = facing & (distance < max(2.5 * float(np.median(distance)), 0.02 * size))
            if good.sum() < 12:
                break
            matrix = _plane_step(moved[good], goals[good], towards[good], size) @ matrix
        refined.append(Placed(matrix, cost(matrix, 0.05 * size)))
    refined.sort(key=lambda p: p.cost)
    best: list[Placed] = []
    for one in refined:
        apart = [np.sqrt(((apply(one.matrix, source) - apply(b.matrix, source)) ** 2).sum(axis=1).mean()) for b in best]
        if all(a > 0.05 * size for a in apart):
            best.append(one)
    return best[:n_best]


def _axes(points: Floats) -> tuple[Floats, Floats]:
    middle = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - middle).T))
    axes = vectors.T[::-1]
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([[1.0], [1.0], [-1.0]])
    return middle, axes


def _matches(middle: Floats, axes: Floats, centre: Floats, others: Floats) -> list[Floats]:
    rotations = [others.T @ turn @ axes for turn in axis_rotations()]
    return [homogeneous(r, centre - r @ middle) for r in rotations]


def _plane_step(points: Floats, goals: Floats, normals: Floats, size: float) -> Floats:
    """Return the small motion that reduces the distances along the normals."""
    centre = points.mean(axis=0)
    rows = np.hstack([np.cross(points - centre, normals) / size, normals])
    left = np.einsum("ij,ij->i", goals - points, normals)
    step = np.linalg.lstsq(rows, left, rcond=1e-10)[0]
    rotation = rotation_vector_matrix(step[:3] / size)
    return homogeneous(rotation, centre + step[3:] - rotation @ centre)
