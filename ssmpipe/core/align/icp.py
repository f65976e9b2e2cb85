"""Rigid alignment of one surface to another from any pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.frames import principal_axes
from ssmpipe.core.align.rigid import (
    apply,
    axis_rotations,
    homogeneous,
    move,
    reflection,
    rigid_fit,
    rotation_vector_matrix,
)
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.distance import sample_surface
from ssmpipe.core.mesh.operators import face_normals, surface_centroid
from ssmpipe.core.mesh.trimesh import TriMesh


@dataclass(frozen=True, eq=False)
class PointSurface:
    """Points spread over a surface with their normals and a search tree, made once per mesh.

    Attributes
    ----------
    points, normals : (n, 3) float64
    tree : scipy.spatial.cKDTree
    coarse : (m,) int64
        A few of the points, for trying many starts.
    coarse_tree : scipy.spatial.cKDTree
    """

    points: Floats
    normals: Floats
    tree: cKDTree
    coarse: np.ndarray
    coarse_tree: cKDTree

    @classmethod
    def of(cls, mesh: TriMesh, n_points: int = 5000, n_coarse: int = 400) -> PointSurface:
        """Sample a mesh, uniformly in area and the same way every time."""
        points, face, _ = sample_surface(mesh, n_points)
        coarse = np.linspace(0, n_points - 1, min(n_coarse, n_points)).astype(np.int64)
        return cls(points, face_normals(mesh)[face], cKDTree(points), coarse, cKDTree(points[coarse]))


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Outcome of an alignment.

    Attributes
    ----------
    matrix : (4, 4) float64
        Proper rigid motion from the source to the target.
    cost : float
        Root mean square of the nearest-point distances along normals, both ways [mm].
    start : str
        Which start won: ``identity`` or ``axes-<k>``.
    n_iterations : int
        Of the final refinement.
    converged : bool
    identity_cost : float
        Cost reached from the identity start [mm].
    """

    matrix: Floats
    cost: float
    start: str
    n_iterations: int
    converged: bool
    identity_cost: float


def refine(source: PointSurface, target: PointSurface, start: Floats, n_iterations: int = 60) -> tuple[Floats, int, bool]:
    """Improve a rigid motion by symmetric point-to-plane ICP (Chen and Medioni 1992).

    Every point of either surface is paired with the nearest point of the other; the linearized motion minimizes the
    distances along the normals of the point that was hit, both directions together.

    Returns
    -------
    matrix : (4, 4), n_iterations : int, converged : bool
        Converged when a step turns by less than 1e-6 rad and shifts by less than 1e-5 of the target's size.
    """
    matrix = np.array(start)
    center = target.points.mean(axis=0)
    size = float(np.sqrt(((target.points - center) ** 2).sum(axis=1).mean()))
    for iteration in range(1, n_iterations + 1):
        moved, turned = apply(matrix, source.points), source.normals @ matrix[:3, :3].T
        there = target.tree.query(moved)[1]
        back = source.tree.query(apply(_inverse(matrix), target.points))[1]
        points = np.vstack([moved, moved[back]])
        goals = np.vstack([target.points[there], target.points])
        normals = np.vstack([target.normals[there], turned[back]])
        rows = np.hstack([np.cross(points - center, normals) / size, normals])
        residual = np.einsum("ij,ij->i", goals - points, normals)
        step = np.linalg.lstsq(rows.T @ rows, rows.T @ residual, rcond=1e-12)[0]
        rotation = rotation_vector_matrix(step[:3] / size)
        matrix = homogeneous(rotation, center + step[3:] - rotation @ center) @ matrix
        if np.linalg.norm(step[:3]) / size < 1e-6 and np.linalg.norm(step[3:]) < 1e-5 * size:
            return _orthonormal(matrix), iteration, True
    return _orthonormal(matrix), n_iterations, False


def cost(source: PointSurface, target: PointSurface, matrix: Floats) -> float:
    """Return the root mean square of distances to the nearest point along its normal, both ways [mm]."""
    moved, turned = apply(matrix, source.points), source.normals @ matrix[:3, :3].T
    there = target.tree.query(moved)[1]
    back = source.tree.query(apply(_inverse(matrix), target.points))[1]
    forth_residual = np.einsum("ij,ij->i", moved - target.points[there], target.normals[there])
    back_residual = np.einsum("ij,ij->i", target.points - moved[back], turned[back])
    return float(np.sqrt(0.5 * (np.mean(forth_residual**2) + np.mean(back_residual**2))))


def screen(source: PointSurface, target: PointSurface, start: Floats, n_iterations: int = 15) -> tuple[Floats, float]:
    """Run a short point-to-point ICP on few points (Besl and McKay 1992); returns the motion and its cost [mm]."""
    matrix = np.array(start)
    few = source.points[source.coarse]
    for _ in range(n_iterations):
        matrix = rigid_fit(apply(matrix, few), target.points[target.tree.query(apply(matrix, few))[1]]) @ matrix
    goal = target.points[target.coarse]
    forth = target.tree.query(apply(matrix, few))[0]
    back = source.tree.query(apply(_inverse(matrix), goal))[0]
    return matrix, float(np.sqrt(0.5 * (np.mean(forth**2) + np.mean(back**2))))


def axis_starts(source: TriMesh, target: TriMesh) -> list[Floats]:
    """Return the 24 proper motions that match centroids and principal axes in any order and direction."""
    axes_a, axes_b = principal_axes(source)[0], principal_axes(target)[0]
    a, b = surface_centroid(source), surface_centroid(target)
    rotations = [axes_b.T @ r @ axes_a for r in axis_rotations()]
    return [homogeneous(r, b - r @ a) for r in rotations]


def align(source: TriMesh, target: TriMesh, *, margin: float = 0.1, n_refined: int = 4, n_points: int = 5000) -> IcpResult:
    """Move a surface rigidly onto another, whatever its pose.

    Starts: the pose as it is, and 24 matches of the principal axes. The best few of these after a short coarse run, and
    always the identity, are refined.

    Parameters
    ----------
    source, target : TriMesh
    margin : float
        Another start must beat the identity's cost by this share to replace it [-]; shapes that were brought to a
        canonical pose before stay in it unless that was clearly wrong.
    n_refined : int
        Coarse results that are refined.
    n_points : int
        Sample points per surface.

    Returns
    -------
    IcpResult
        The determinant of the rotation is +1 always.
    """
    a, b = PointSurface.of(source, n_points), PointSurface.of(target, n_points)
    starts = [homogeneous(np.eye(3), np.zeros(3)), *axis_starts(source, target)]
    screened = [screen(a, b, start) for start in starts]
    order = [0, *(1 + np.argsort([c for _, c in screened[1:]], kind="stable")[:n_refined]).tolist()]
    refined: list[tuple[float, int, Floats, int, bool]] = []
    for k in order:
        if any(np.abs(screened[k][0] - screened[j][0]).max() < 1e-3 for _, j, *_ in refined):
            continue
        matrix, n, converged = refine(a, b, starts[0] if k == 0 else screened[k][0])
        refined.append((cost(a, b, matrix), k, matrix, n, converged))
        if k == 0 and cost(a, b, matrix) > 1.5 * screened[0][1]:  # the coarse run may escape where the fine one is caught
            matrix, n, converged = refine(a, b, screened[0][0])
            refined[0] = (cost(a, b, matrix), k, matrix, n, converged)
    identity = refined[0]
    best = min(refined, key=lambda r: (r[0], r[1]))
    chosen = best if best[0] < (1.0 - margin) * identity[0] else identity
    name = "identity" if chosen[1] == 0 else f"axes-{chosen[1]}"
    return IcpResult(chosen[2], chosen[0], name, chosen[3], chosen[4], identity[0])


def fits_better_mirrored(source: TriMesh, target: TriMesh, result: IcpResult, *, margin: float = 0.05) -> tuple[bool, float]:
    """Say whether the mirror image of an aligned shape fits clearly better, and its cost [mm].

    A sign of a wrong left/right label.
    """
    placed = move(source, result.matrix)
    center = surface_centroid(placed)
    flip = homogeneous(np.eye(3), center) @ reflection(0) @ homogeneous(np.eye(3), -center)
    mirrored = align(move(placed, flip), target)
    return mirrored.cost < (1.0 - margin) * result.cost, mirrored.cost


def _inverse(matrix: Floats) -> Floats:
    rotation = matrix[:3, :3].T
    return homogeneous(rotation, -rotation @ matrix[:3, 3])


def _orthonormal(matrix: Floats) -> Floats:
    """Remove rounding from a product of rotations."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return homogeneous(u @ vt, matrix[:3, 3])
