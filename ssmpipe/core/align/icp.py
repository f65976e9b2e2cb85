"""Rigid alignment of one surface to another from any pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import sample_surface
from ssmpipe.core.mesh.numbering import canonical_order
from ssmpipe.core.mesh.operators import face_normals, surface_centroid
from ssmpipe.core.mesh.trimesh import TriMesh

_SLID = 1.5
"""A pose whose nearest points lie so many times farther than in the nearest pose is out of the question."""


@dataclass(frozen=True)
class Region:
    """A slab of the target: between two fractions of its extent along a coordinate axis."""

    axis: int
    low: float
    high: float

    def contains(self, points: Floats, vertices: Floats) -> Bools:
        """Say which points lie in the slab of the surface with these vertices.

        Raises
        ------
        GeometryError
            If fewer than a hundredth of the points do.
        """
        start, end = float(vertices[:, self.axis].min()), float(vertices[:, self.axis].max())
        share = (points[:, self.axis] - start) / (end - start)
        inside = (share >= self.low) & (share <= self.high)
        if inside.mean() < 0.01:
            raise GeometryError(
                f"the region from {self.low:g} to {self.high:g} of the reference holds {100 * inside.mean():.1f} % of it",
                "widen align.region",
            )
        return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class Ball:
    """The part of a surface within a radius of a point."""

    center: Floats
    radius: float

    def contains(self, points: Floats, vertices: Floats) -> Bools:
        """Say which points lie in the ball; ``vertices`` are those of the surface.

        Raises
        ------
        GeometryError
            If fewer than a hundredth of the points do.
        """
        inside = ((points - self.center) ** 2).sum(axis=1) <= self.radius**2
        if inside.mean() < 0.01:
            x, y, z = self.center
            nearest = float(np.sqrt(((vertices - self.center) ** 2).sum(axis=1).min()))
            raise GeometryError(
                f"within {self.radius:g} mm of the landmark at ({x:.1f}, {y:.1f}, {z:.1f}) mm lies {100 * inside.mean():.1f} % of the "
                f"surface, which is {nearest:.1f} mm away",
                "raise align.region_radius_mm, or check the landmark",
            )
        return np.asarray(inside)

    def moved(self, matrix: Floats) -> Ball:
        """Return the ball after a rigid motion or reflection."""
        return Ball(apply(matrix, self.center[None])[0], self.radius)


@dataclass(frozen=True, eq=False)
class PointSurface:
    """Points spread over a surface with their normals and a search tree, made once per mesh.

    Attributes
    ----------
    points, normals : (n, 3) float64
    tree : scipy.spatial.cKDTree
    active : (n,) bool, optional
        Points that count, with those of the other surface that lie nearest to them; all by default.
    """

    points: Floats
    normals: Floats
    tree: cKDTree
    active: Bools | None = None

    @classmethod
    def of(
        cls,
        mesh: TriMesh,
        n_points: int,
        region: Region | Ball | None = None,
        order: tuple[Ints, Ints] | None = None,
    ) -> PointSurface:
        """Sample a mesh, uniformly in area and the same way every time; see :func:`ssmpipe.core.mesh.distance.sample_surface`."""
        points, face, _ = sample_surface(mesh, n_points, order=order)
        active = None if region is None else region.contains(points, mesh.vertices)
        return cls(points, face_normals(mesh)[face], cKDTree(points), active)


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
        Which start won: ``identity``, ``screened`` (the identity after the coarse run) or ``axes-<k>``.
    n_iterations : int
        Of the final refinement.
    converged : bool
    identity_cost : float
        Cost reached from the identity start [mm].
    scale : float
        Factor by which the source was enlarged while its pose was sought; it is not in the matrix [-].
    """

    matrix: Floats
    cost: float
    start: str
    n_iterations: int
    converged: bool
    identity_cost: float
    scale: float = 1.0


def refine(
    source: PointSurface, target: PointSurface, start: Floats, n_iterations: int = 60, *, scaled: bool = False
) -> tuple[Floats, int, bool]:
    """Improve a rigid motion, or a motion with a change of size, by symmetric point-to-plane ICP (Chen and Medioni 1992).

    Every point of either surface is paired with the nearest point of the other; the linearized motion minimizes the
    distances along the normals of the point that was hit, both directions together. With ``scaled`` the size changes as well, by
    at most a tenth per step.

    Returns
    -------
    matrix : (4, 4)
        The motion with the smallest cost on the way; times a scale with ``scaled``.
    n_iterations : int
    converged : bool
        When a step turns by less than 1e-7 rad and shifts by less than 1e-7 of the target's size, or the cost has not
        fallen by 1e-4 of itself for six steps (pairs of points then change back and forth).
    """
    matrix = np.array(start)
    center = target.points.mean(axis=0)
    size = float(np.sqrt(((target.points - center) ** 2).sum(axis=1).mean()))
    best, lowest, lowest_at = matrix, np.inf, 0
    for iteration in range(1, n_iterations + 1):
        points, goals, normals = pairs(source, target, matrix)
        residual = np.einsum("ij,ij->i", goals - points, normals)
        now = float(residual @ residual)
        if now < lowest:
            best = matrix
            if now < (1.0 - 2e-4) * lowest:
                lowest_at = iteration
            lowest = now
        if iteration - lowest_at >= 6:
            return _orthonormal(best), iteration, True
        arms = points - center
        rows = np.hstack([np.cross(arms, normals) / size, normals])
        if scaled:
            rows = np.hstack([rows, np.einsum("ij,ij->i", arms, normals)[:, None] / size])
        step = np.linalg.lstsq(rows.T @ rows, rows.T @ residual, rcond=1e-12)[0]
        linear = rotation_vector_matrix(step[:3] / size)
        if scaled:
            linear = linear * (1.0 + float(np.clip(step[6] / size, -0.1, 0.1)))
        matrix = homogeneous(linear, center + step[3:6] - linear @ center) @ matrix
        if max(np.linalg.norm(step[:3]), np.linalg.norm(step[3:])) < 1e-7 * size:
            return _orthonormal(matrix), iteration, True
    return _orthonormal(best), n_iterations, False


def cost(source: PointSurface, target: PointSurface, matrix: Floats) -> float:
    """Return the root mean square of distances to the nearest point along its normal, both ways [mm]."""
    points, goals, normals = pairs(source, target, matrix)
    squared = np.einsum("ij,ij->i", goals - points, normals) ** 2
    n = len(squared) - (len(target.points) if target.active is None else int(target.active.sum()))
    return float(np.sqrt(0.5 * (squared[:n].mean() + squared[n:].mean())))


def distance(source: PointSurface, target: PointSurface, matrix: Floats) -> float:
    """Return the root mean square of distances to the nearest point, both ways [mm].

    Along normals, what stands out beyond the end of an open tube costs nothing: a pose in which this distance is much larger than in
    another one has slid out of the target.
    """
    points, goals, _ = pairs(source, target, matrix)
    squared = ((goals - points) ** 2).sum(axis=1)
    n = len(squared) - (len(target.points) if target.active is None else int(target.active.sum()))
    return float(np.sqrt(0.5 * (squared[:n].mean() + squared[n:].mean())))


def screen(source: PointSurface, target: PointSurface, start: Floats, n_iterations: int = 15) -> tuple[Floats, float]:
    """Run a short point-to-point ICP (Besl and McKay 1992), meant for few points; returns the motion and its cost [mm]."""
    matrix = np.array(start)
    active = target.active
    for _ in range(n_iterations):
        moved = apply(matrix, source.points)
        there = target.tree.query(moved)[1]
        if active is not None:
            moved, there = moved[active[there]], there[active[there]]
            if len(moved) < 6:
                return matrix, np.inf
        matrix = rigid_fit(moved, target.points[there]) @ matrix
    forth, there = target.tree.query(apply(matrix, source.points))
    goals = target.points if active is None else target.points[active]
    back = source.tree.query(apply(_inverse(matrix), goals))[0]
    if active is not None:
        forth = forth[active[there]]
        if len(forth) < 6:
            return matrix, np.inf
    return matrix, float(np.sqrt(0.5 * (np.mean(forth**2) + np.mean(back**2))))


def axis_starts(source: TriMesh, target: TriMesh) -> list[Floats]:
    """Return the 24 proper motions that match centroids and principal axes in any order and direction."""
    axes_a, axes_b = principal_axes(source)[0], principal_axes(target)[0]
    a, b = surface_centroid(source), surface_centroid(target)
    rotations = [axes_b.T @ r @ axes_a for r in axis_rotations()]
    return [homogeneous(r, b - r @ a) for r in rotations]


def align(
    source: TriMesh,
    target: TriMesh,
    *,
    margin: float = 0.1,
    n_refined: int = 4,
    n_points: int = 5000,
    region: Region | Ball | None = None,
    ball: Ball | None = None,
    scaled: bool = True,
) -> IcpResult:
    """Move a surface rigidly onto another, whatever its pose.

    Starts: the pose as it is, and 24 matches of the principal axes. A short run on few points screens them; the best
    few are refined on more points, the identity and the winner on all.

    The pose is sought at equal size: a small bone inside of a large one lies askew where it fits best, and turned end for end as
    well as not. The motion that is returned has no scale: it turns the shape as it was found, about its own centroid.

    Parameters
    ----------
    source, target : TriMesh
    margin : float
        Another start must beat the identity's cost by this share to replace it [-]; shapes that were brought to a
        canonical pose before stay in it unless that was clearly wrong.
    n_refined : int
        Screened results that are refined.
    n_points : int
        Sample points per surface.
    region : Region or Ball, optional
        Part of the target that counts; what lies nearest to the rest of it is left out (shafts of different length). The sizes
        are then kept.
    ball : Ball, optional
        Instead: part of the source that counts, around a landmark of its own. The sizes are then kept.
    scaled : bool
        Whether the pose is sought at equal size.

    Returns
    -------
    IcpResult
        The determinant of the rotation is +1 always.
    """
    if ball is not None:
        # the same distances count both ways: move the target onto the source, and turn that around
        back = align(target, source, margin=margin, n_refined=n_refined, n_points=n_points, region=ball)
        return replace(back, matrix=_inverse(back.matrix))
    orders = canonical_order(source), canonical_order(target)
    few, some, all_points = (
        (PointSurface.of(source, n, order=orders[0]), PointSurface.of(target, n, region, orders[1]))
        for n in (min(400, n_points), min(1200, n_points), n_points)
    )
    scaled = scaled and region is None
    middle, factor = all_points[0].points.mean(axis=0), 1.0
    if scaled:
        factor = _spread(all_points[1]) / _spread(all_points[0])
    unmoved = homogeneous(factor * np.eye(3), (1.0 - factor) * middle)
    matrix, n_iterations, converged = refine(*all_points, unmoved, scaled=scaled)
    identity_cost, identity_distance = cost(*all_points, matrix), distance(*all_points, matrix)
    best = IcpResult(matrix, identity_cost, "identity", n_iterations, converged, identity_cost)
    starts = [unmoved, *(m @ unmoved for m in axis_starts(source, target))]
    if isinstance(region, Ball):
        # the rest of both shapes may differ in length: their middles need not match
        starts, n_refined = starts + _slid(starts[1:], target), 2 * n_refined
    screened = [screen(*few, start) for start in starts]
    order = np.argsort([c for _, c in screened], kind="stable")[:n_refined]
    candidates = [(refine(*some, screened[k][0], scaled=scaled)[0], int(k)) for k in order]
    gaps = [distance(*all_points, c[0]) for c in candidates]
    limit = _SLID * min(identity_distance, *gaps)
    slid = identity_distance > limit
    kept = [c for c, gap in zip(candidates, gaps, strict=True) if gap <= limit]
    if kept:
        found, k = min(kept, key=lambda c: (cost(*all_points, c[0]), c[1]))
        if slid or cost(*all_points, found) < (1.0 - 0.5 * margin) * identity_cost:
            matrix, n_iterations, converged = refine(*all_points, found, scaled=scaled)
            other = cost(*all_points, matrix)
            if slid or other < (1.0 - margin) * identity_cost:
                start = "screened" if k == 0 else f"axes-{k}"
                best = IcpResult(matrix, other, start, n_iterations, converged, identity_cost)
    if not scaled:
        return best
    scale = _scale(best.matrix)
    rotation = best.matrix[:3, :3] / scale
    rigid = homogeneous(rotation, apply(best.matrix, middle[None])[0] - rotation @ middle)
    return replace(best, matrix=_orthonormal(rigid), scale=scale)


def _spread(surface: PointSurface) -> float:
    """Return the root mean square distance of the points from their centroid [mm]."""
    return float(np.sqrt(surface.points.var(axis=0).sum()))


def _scale(matrix: Floats) -> float:
    return float(np.linalg.det(matrix[:3, :3]) ** (1.0 / 3.0))


def fits_better_mirrored(
    source: TriMesh,
    target: TriMesh,
    result: IcpResult,
    *,
    margin: float = 0.05,
    n_points: int = 5000,
    region: Region | None = None,
    ball: Ball | None = None,
) -> tuple[bool, float]:
    """Say whether the mirror image of an aligned shape fits clearly better, and its cost [mm].

    A sign of a wrong left/right label.
    """
    mirrored = align_mirrored(source, target, result, n_points=n_points, region=region, ball=ball)
    return mirrored.cost < (1.0 - margin) * result.cost, mirrored.cost


def align_mirrored(
    source: TriMesh,
    target: TriMesh,
    result: IcpResult,
    *,
    n_points: int = 5000,
    region: Region | None = None,
    ball: Ball | None = None,
) -> IcpResult:
    """Align the mirror image of an aligned shape; the matrix has determinant -1 and moves the shape as it was given.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import star_shape
    >>> lump = star_shape(2)
    >>> result = align_mirrored(lump, lump, align(lump, lump, n_points=500), n_points=500)
    >>> round(float(np.linalg.det(result.matrix)), 6)
    -1.0
    """
    placed = move(source, result.matrix)
    center = surface_centroid(placed)
    flip = homogeneous(np.eye(3), center) @ reflection(0) @ homogeneous(np.eye(3), -center)
    other = None if ball is None else ball.moved(flip @ result.matrix)
    mirrored = align(move(placed, flip), target, n_points=n_points, region=region, ball=other)
    return replace(mirrored, matrix=mirrored.matrix @ flip @ result.matrix)


def pairs(source: PointSurface, target: PointSurface, matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return moved source points, the target points they belong to, and the normals to measure along, both ways."""
    back_matrix = _inverse(matrix)
    moved, turned = apply(matrix, source.points), source.normals @ back_matrix[:3, :3]
    turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    there = target.tree.query(moved)[1]
    seen = target.points if target.active is None else target.points[target.active]
    back = source.tree.query(apply(back_matrix, seen))[1]
    forth = moved
    if target.active is not None:
        counts = target.active[there]
        forth, there = moved[counts], there[counts]
    points = np.vstack([forth, moved[back]])
    goals = np.vstack([target.points[there], seen])
    return points, goals, np.vstack([target.normals[there], turned[back]])


def _slid(starts: list[Floats], target: TriMesh) -> list[Floats]:
    """Return starts moved along the first principal axis of the target by shares of its extent."""
    axis = principal_axes(target)[0][0]
    extent = float(np.ptp(target.vertices @ axis))
    shifts = [homogeneous(np.eye(3), share * extent * axis) for share in (-0.3, -0.15, 0.15, 0.3)]
    return [shift @ start for shift in shifts for start in starts]


def _inverse(matrix: Floats) -> Floats:
    linear = np.asarray(np.linalg.inv(matrix[:3, :3]), dtype=np.float64)
    return homogeneous(linear, -linear @ matrix[:3, 3])


def _orthonormal(matrix: Floats) -> Floats:
    """Remove rounding from a product of rotations, and of one scale."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return homogeneous(_scale(matrix) * (u @ vt), matrix[:3, 3])
