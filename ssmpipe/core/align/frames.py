"""Canonical frames found from geometry: principal axes, and the axes of a distal femur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from ssmpipe.core.align.rigid import homogeneous
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError, LandmarkError
from ssmpipe.core.mesh.operators import face_vectors, surface_centroid, surface_covariance
from ssmpipe.core.mesh.sections import section_areas
from ssmpipe.core.mesh.trimesh import TriMesh


@dataclass(frozen=True, eq=False)
class Frame:
    """A canonical frame.

    Attributes
    ----------
    matrix : (4, 4) float64
        Moves points into the frame; a proper rigid motion.
    width : float
        Medio-lateral width of the condyles [mm]; the square root of the smallest variance for principal axes.
    tangent : float
        Length of the straight side of the condyles' outline over the width [-]; about one half for a femur.
    overhang : float
        How far the condyles reach behind the shaft axis over how far they reach before it, minus one [-]; positive when the
        two signs of "posterior" agree. Zero for principal axes.
    """

    matrix: Floats
    width: float
    tangent: float = 0.0
    overhang: float = 0.0


def principal_axes(mesh: TriMesh) -> tuple[Floats, Floats]:
    """Return the principal axes of the surface as rows (longest first, right-handed), and the variances [mm^2].

    Signs are such that the surface is skewed towards the positive side of the first two axes; a surface without skewness
    gets arbitrary but repeatable signs.
    """
    variances, vectors = np.linalg.eigh(surface_covariance(mesh))
    axes = vectors[:, ::-1].T.copy()
    area = np.linalg.norm(face_vectors(mesh), axis=1)
    centers = mesh.vertices[mesh.faces].mean(axis=1) - surface_centroid(mesh)
    for k in range(2):
        if area @ (centers @ axes[k]) ** 3 < 0:
            axes[k] = -axes[k]
    axes[2] = np.cross(axes[0], axes[1])
    return axes, variances[::-1]


def principal_frame(mesh: TriMesh) -> Frame:
    """Return the frame of the principal axes: x longest, z shortest, origin in the surface's centroid."""
    axes, variances = principal_axes(mesh)
    return Frame(homogeneous(axes, -axes @ surface_centroid(mesh)), float(np.sqrt(variances[2])))


def femur_distal_frame(mesh: TriMesh, n_rounds: int = 6) -> Frame:
    """Find the frame of a right distal femur from its shape: x lateral, y anterior, z proximal along the shaft.

    1. Direction of the shaft. A long piece: the first principal axis; the distal end is the one whose outer part has the
       larger sections. A short stump: the direction along which one end is a cylinder, i.e. face normals there are
       perpendicular to it.
    2. Seen along the shaft, the outline of the condyles has one long straight side, the common tangent of the posterior
       condyles over the intercondylar fossa. It is the medio-lateral direction and its outside is posterior.
    3. The shaft axis is the line through the centroids of the sections between 1.0 and 1.6 condylar widths above the lowest point
       (as far as the scan reaches). Steps 2 and 3 are repeated.

    The origin lies in the middle of the condyles' outline, at the height of the lowest point. A left femur has to be
    mirrored first: its x axis would point medially.

    Parameters
    ----------
    mesh : TriMesh
        Closed, or open at the shaft only; a whole femur or its distal part; any pose [mm].

    Returns
    -------
    Frame

    Raises
    ------
    GeometryError
        If the piece has too little shaft, no fossa between two condyles, or no shaft that is thinner than the condyles and
        of even thickness.
    """
    z = _shaft_direction(mesh)
    # independent of where the mesh lies: work about its own centroid
    origin = surface_centroid(mesh)
    local = TriMesh(mesh.vertices - origin, mesh.faces)
    points = local.vertices[np.unique(local.faces)]
    line = np.zeros(3)
    total, tangent, overhang, width, y = 0.0, 0.0, 0.0, 0.0, np.zeros(3)
    condyles, areas = points, np.zeros(0)
    for _ in range(n_rounds):
        lowest = float((points @ z).min())
        condyles = _below(points, z, lowest, 0.5)
        x, y, tangent, overhang = _posterior_tangent(condyles, z, line)
        width, total = float(np.ptp(condyles @ x)), float(np.ptp(points @ z))
        if total < 1.05 * width:
            raise GeometryError(
                f"the piece is {total / width:.2f} condylar widths high, too little shaft to orient a femur by",
                "scan more of the shaft (1.2 widths or more), or assign the roles lateral, medial and proximal to landmarks",
            )
        top = min(lowest + 1.6 * width, float((points @ z).max()) - 0.05 * width)
        bottom = min(lowest + 1.0 * width, top - 0.2 * width)
        areas, centroids = section_areas(local, z, np.linspace(bottom, top, 13))
        seen = areas > 0
        if seen.sum() < 5:
            raise GeometryError(
                "no shaft found above the condyles", "check that the scan is a femur, or use frame: principal"
            )
        line = centroids[seen].mean(axis=0)
        direction = np.linalg.svd(centroids[seen] - line)[2][0]
        z = direction if direction @ z > 0 else -direction
    lowest = float((points @ z).min())
    thick = float(section_areas(local, z, lowest + width * np.linspace(0.1, 0.5, 9))[0].max())
    shaft = areas[areas > 0]
    share, spread = float(np.median(shaft)) / thick, float(shaft.max() / shaft.min())
    if tangent < 0.3 or share > 0.7 or spread > 2.5:
        raise GeometryError(
            f"no distal femur recognized: the straight side over the fossa is {tangent:.2f} widths long (expected 0.5), the shaft has "
            f"{100 * share:.0f} % of the condyles' section (expected 20 to 50 %), its largest section is {spread:.1f} times its "
            "smallest (expected 1.2 to 1.6)",
            "check that the scan shows one distal femur, or assign the roles lateral, medial and proximal to landmarks",
        )
    x = np.cross(y, z)
    y = np.cross(z, x / np.linalg.norm(x))
    placed = place_axes(mesh, np.array([np.cross(y, z), y, z]))
    return Frame(placed.matrix, placed.width, tangent, overhang)


def place_axes(mesh: TriMesh, axes: Floats) -> Frame:
    """Return the frame with the given axes (rows) whose origin is below the middle of the lowest part.

    The lowest part is what lies below half of its own width; the origin has the height of the lowest point.
    """
    points = mesh.vertices[np.unique(mesh.faces)] @ axes.T
    z = np.array([0.0, 0.0, 1.0])
    lowest_part = _below(points, z, float(points[:, 2].min()), 0.5)
    middle = 0.5 * (lowest_part.min(axis=0) + lowest_part.max(axis=0))
    middle[2] = lowest_part[:, 2].min()
    return Frame(homogeneous(axes, -middle), float(np.ptp(lowest_part[:, 0])))


def landmark_frame(lateral: Floats, medial: Floats, proximal: Floats) -> Floats:
    """Return axes as rows (x lateral, y anterior, z proximal) of a right femur from three points.

    z runs from the middle of the two distal points to the proximal one; x is the part of medial-to-lateral across it.

    Raises
    ------
    LandmarkError
        If the points are on one line.

    Examples
    --------
    >>> landmark_frame(np.array([1.0, 0, 0]), np.array([-1.0, 0, 0]), np.array([0, 0, 5.0]))
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    z = proximal - 0.5 * (lateral + medial)
    across = lateral - medial
    y = np.cross(z, across)
    if np.linalg.norm(y) < 1e-6 * np.linalg.norm(z) * np.linalg.norm(across) or not np.linalg.norm(y) > 0:
        raise LandmarkError("the landmarks lateral, medial and proximal lie on one line", "check input.roles")
    y, z = y / np.linalg.norm(y), z / np.linalg.norm(z)
    return np.array([np.cross(y, z), y, z])


def _below(points: Floats, z: Floats, lowest: float, fraction: float) -> Floats:
    """Return the points lower than ``fraction`` times their own largest extent across z."""
    height = points @ z - lowest
    width = np.inf
    inside = np.ones(len(points), dtype=bool)
    for _ in range(50):
        flat = points[inside] - np.outer(points[inside] @ z, z)
        hull = flat[np.unique(ConvexHull(_plane_coordinates(flat, z)).vertices)]
        diameter = float(np.linalg.norm(hull[:, None] - hull[None], axis=2).max())
        if diameter >= width * (1 - 1e-9):
            break
        width = diameter
        inside = height < fraction * width
    return points[inside]


def _plane_coordinates(points: Floats, z: Floats) -> Floats:
    return np.asarray(points @ _perpendicular(z).T)


def _perpendicular(z: Floats) -> Floats:
    """Return two unit vectors (2, 3) that make a right-handed frame with z."""
    a = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    a /= np.linalg.norm(a)
    return np.array([a, np.cross(z, a)])


def _posterior_tangent(condyles: Floats, z: Floats, line: Floats) -> tuple[Floats, Floats, float, float]:
    """Return x, y, the side's length over the width, and the overhang, from the longest side of the outline seen along z."""
    basis = _perpendicular(z)
    flat = condyles @ basis.T
    hull = flat[ConvexHull(flat).vertices]  # counter-clockwise
    sides = np.roll(hull, -1, axis=0) - hull
    k = int(np.argmax(np.linalg.norm(sides, axis=1)))
    along = sides[k] / np.linalg.norm(sides[k])
    outward = np.array([along[1], -along[0]])
    y = -(outward @ basis)
    x = np.cross(y, z)
    behind = float((hull[k] - basis @ line) @ outward)
    before = float(-((hull - basis @ line) @ outward).min())
    length = float(np.linalg.norm(sides[k])) / float(np.ptp(condyles @ x))
    return x, y, length, behind / before - 1.0 if before > 0 else np.inf


def _shaft_direction(mesh: TriMesh) -> Floats:
    """Return the unit vector from the condyles up the shaft."""
    axes, _ = principal_axes(mesh)
    extent = np.ptp(mesh.vertices[np.unique(mesh.faces)] @ axes.T, axis=0)
    if extent[0] > 2.0 * extent[1]:
        z = axes[0]
        height = mesh.vertices[np.unique(mesh.faces)] @ z
        at = np.linspace(0.02, 0.10, 9) * extent[0]
        low = section_areas(mesh, z, height.min() + at)[0].mean()
        high = section_areas(mesh, z, height.max() - at)[0].mean()
        return z if low > high else -z
    return cylinder_end(mesh)


def cylinder_end(mesh: TriMesh, n_directions: int = 600) -> Floats:
    """Return the direction towards the end of a stump that is most like a cylinder (without its flat cut)."""
    vectors = face_vectors(mesh)
    area = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.where(area > 0, area, 1.0)[:, None]
    centers = mesh.vertices[mesh.faces].mean(axis=1)

    def score(directions: Floats) -> Floats:
        height = centers @ directions.T
        low, high = height.min(axis=0), height.max(axis=0)
        level = (height - low) / (high - low)
        cosine = normals @ directions.T
        weight = area[:, None] * ((level > 0.75) & (level < 0.97) & (cosine < 0.95))
        return np.asarray((weight * cosine**2).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))

    k = np.arange(n_directions) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / n_directions), np.pi * (1 + 5**0.5) * k
    # about the principal axes, so that the search turns with the bone
    axes, _ = principal_axes(mesh)
    ball = np.column_stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)]) @ axes
    best = ball[int(np.argmin(score(ball)))]
    for step in (0.05, 0.02, 0.01, 0.004):
        offsets = step * np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)]) @ _perpendicular(best)
        near = best + offsets
        near /= np.linalg.norm(near, axis=1, keepdims=True)
        best = near[int(np.argmin(score(near)))]
    return np.asarray(best)
