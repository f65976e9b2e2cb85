"""The frame of a proximal femur, and its lesser trochanter, from geometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from ssmpipe.core.align.frames import Frame, cylinder_end, principal_axes
from ssmpipe.core.align.rigid import homogeneous
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import face_vectors, surface_centroid
from ssmpipe.core.mesh.sections import section_areas, section_segments
from ssmpipe.core.mesh.topology import boundary_loops, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh

_SLENDER = 3.3
"""A femur more than so many times longer than wide has its first principal axis along the shaft."""
_NEAREST = 1.5
"""The lesser trochanter lies more than so many radii of the head below its centre (2 to 3 as a rule)."""
_REFUSED = "check that the scan shows a femur with its head, or use frame: principal"


@dataclass(frozen=True, eq=False)
class ProximalFemur:
    """What geometry tells of a proximal femur, in the coordinates of the mesh [mm].

    Attributes
    ----------
    axis : (3,) float64
        Unit vector up the shaft below the lesser trochanter.
    origin : (3,) float64
        A point of the shaft's axis.
    diameter : float
        Of a circle with the area of the shaft's section.
    head : (3,) float64
        Centre of the sphere that fits the femoral head.
    head_radius : float
    trochanter : (3,) float64
        Apex of the lesser trochanter: the point of the lowest bulge farthest from the axis.
    bulge : float
        By how much the apex stands out over its wider surroundings; below 1 mm it is doubtful.
    """

    axis: Floats
    origin: Floats
    diameter: float
    head: Floats
    head_radius: float
    trochanter: Floats
    bulge: float


def analyze_proximal_femur(mesh: TriMesh, n_rounds: int = 3) -> ProximalFemur:
    """Find shaft, head and lesser trochanter of a femur, whole or cut below the lesser trochanter, in any pose.

    1. The shaft runs along the first principal axis of a long piece; of a shorter one across its cut, or towards the end that is
       like a cylinder. Where one guess leads to no head, the next one is tried.
       The end whose sections lie farther off the line through the thin sections is the one with the head.
    2. The head is a sphere fitted to what lies farthest from the shaft's axis.
    3. The distance of the surface from the axis, as a function of height and angle, has a bulge at the lesser trochanter: the
       lowest local maximum beside the neck. It is the same for left and right.
    4. The axis is fitted anew to the centroids of the sections up to 3 shaft diameters below the trochanter, and 2 and 3 are repeated.

    Parameters
    ----------
    mesh : TriMesh
        Closed, or open at the shaft [mm].

    Raises
    ------
    GeometryError
        If there is no head beside the shaft, or no bulge.
    """
    center = surface_centroid(mesh)
    local = TriMesh(mesh.vertices - center, mesh.faces)
    points = local.vertices[np.unique(local.faces)]
    found, refusal = None, None
    for start in _first_axes(local, points):
        # a strongly bowed shaft, or a flat place elsewhere, can mislead about the end
        try:
            found = _from_start(local, points, start, n_rounds)
            break
        except GeometryError as error:
            refusal = refusal or error
    if found is None:
        raise refusal or GeometryError("no shaft found below the femoral head", _REFUSED)
    return replace(found, origin=found.origin + center, head=found.head + center, trochanter=found.trochanter + center)


def femur_proximal_frame(mesh: TriMesh, found: ProximalFemur | None = None) -> Frame:
    """Return the frame of a right proximal femur: z up the shaft, x lateral (away from the head), y anterior.

    The origin lies on the shaft's axis at the height of the head's centre. A left femur has to be mirrored first: its y axis
    would point backward. ``width`` is the diameter of the head. ``found`` is what :func:`analyze_proximal_femur` gives, if that is
    known already.

    Raises
    ------
    GeometryError
        See :func:`analyze_proximal_femur`.
    """
    found = found or analyze_proximal_femur(mesh)
    z = found.axis
    to_head = found.head - found.origin
    height = float(to_head @ z)
    x = -(to_head - height * z)
    x /= np.linalg.norm(x)
    axes = np.array([x, np.cross(z, x), z])
    return Frame(homogeneous(axes, -axes @ (found.origin + height * z)), 2.0 * found.head_radius)


def _from_start(local: TriMesh, points: Floats, start: tuple[Floats, Floats, float], n_rounds: int) -> ProximalFemur:
    z, origin, diameter = start
    head, radius = _head(points, z, origin)
    # the trochanter lies about 2 to 3 radii below the head's centre; start with the shaft just below that
    top, bottom = float(head @ z) - 3.5 * radius, float(head @ z) - 6.0 * radius
    apex, bulge = head, 0.0
    for _ in range(n_rounds + 1):
        bottom = max(float((points @ z).min()) + 0.15 * diameter, bottom)
        if top - bottom > 0.5 * diameter:
            areas, centroids = section_areas(local, z, np.linspace(bottom, top, 25))
            seen = areas > 0
            origin = centroids[seen].mean(axis=0)
            direction = np.linalg.svd(centroids[seen] - origin)[2][0]
            z = direction if direction @ z > 0 else -direction
            diameter = float(np.sqrt(4.0 / np.pi * np.median(areas[seen])))
            head, radius = _head(points, z, origin)
        apex, bulge = _lowest_bulge(local, points, z, origin, head, radius, diameter)
        top, bottom = float(apex @ z) - 0.5 * diameter, float(apex @ z) - 3.0 * diameter
    if not 0.5 < radius / diameter < 1.2 or bulge > 0.45 * diameter:
        raise GeometryError(
            f"no femoral head found: a sphere of {radius:.1f} mm radius on a shaft of {diameter:.1f} mm diameter, with a bulge of "
            f"{bulge:.1f} mm, is none",
            _REFUSED,
        )
    return ProximalFemur(z, origin, diameter, head, radius, apex, bulge)


def _first_axes(mesh: TriMesh, points: Floats) -> Iterator[tuple[Floats, Floats, float]]:
    """Yield directions towards the head, points of the axis, and diameters of the shaft, all roughly, the likeliest first.

    The principal axis of a piece that is not much longer than wide leans towards the head: the cut tells more.
    """
    axes, _ = principal_axes(mesh)
    extent = np.ptp(points @ axes.T, axis=0)
    slender = extent[0] > _SLENDER * extent[1]
    if slender:
        yield from _axes_along(mesh, points, axes[0], long=True)
    cut = _cut_direction(mesh)
    for find in (lambda: -cut, lambda: -cylinder_end(mesh), lambda: cut):
        yield from _axes_along(mesh, points, find(), long=False)
    if not slender:
        yield from _axes_along(mesh, points, axes[0], long=True)


def _axes_along(mesh: TriMesh, points: Floats, z: Floats, long: bool) -> list[tuple[Floats, Floats, float]]:
    low, high = float((points @ z).min()), float((points @ z).max())
    at = low + (high - low) * np.linspace(0.02, 0.98, 49)
    areas, centroids = section_areas(mesh, z, at)
    seen = areas > 0
    if not long:
        seen &= at < low + 0.35 * (high - low)
    inner = seen & (at > low + 0.04 * (high - low)) & (at < high - 0.04 * (high - low))
    if inner.sum() < 4:
        return []
    thin = inner & (areas < 1.5 * np.quantile(areas[inner], 0.1))
    origin = centroids[thin].mean(axis=0)
    direction = np.linalg.svd(centroids[thin] - origin)[2][0] if long and thin.sum() >= 4 else z
    direction = direction if direction @ z > 0 else -direction
    diameter = float(np.sqrt(4.0 / np.pi * np.median(areas[thin])))
    if long:
        off = np.linalg.norm(np.cross(centroids - origin, direction), axis=1)
        share = (at - low) / (high - low)
        if np.nanmax(off[share < 0.15]) > np.nanmax(off[share > 0.85]):
            direction = -direction
        return [_upper_axis(centroids[thin], origin, sign * direction, diameter) for sign in (1.0, -1.0)]
    return [(direction, origin, diameter)]


def _upper_axis(centroids: Floats, origin: Floats, direction: Floats, diameter: float) -> tuple[Floats, Floats, float]:
    """Return the line through the upper half of the shaft, which is bowed."""
    upper = centroids[(centroids - origin) @ direction >= 0]
    if len(upper) < 4:
        return direction, origin, diameter
    middle = upper.mean(axis=0)
    line = np.linalg.svd(upper - middle)[2][0]
    return line if line @ direction > 0 else -line, middle, diameter


def _cut_direction(mesh: TriMesh) -> Floats:
    """Return about the direction out of the cut shaft: across the rim, across a flat cap, or towards a cylinder's end."""
    loops = boundary_loops(mesh.faces)
    if loops:
        rim = mesh.vertices[max(loops, key=lambda loop: loop_length(mesh, loop))]
        normal = np.linalg.svd(rim - rim.mean(axis=0))[2][2]
        return np.asarray(normal if normal @ (rim.mean(axis=0) - surface_centroid(mesh)) > 0 else -normal)
    vectors = face_vectors(mesh)
    area = np.linalg.norm(vectors, axis=1)
    normals = vectors / np.where(area > 0, area, 1.0)[:, None]
    largest = normals[np.argsort(-area, kind="stable")[:: max(1, mesh.n_faces // 800)]]
    share = ((normals @ largest.T > np.cos(np.radians(4.0))) * area[:, None]).sum(axis=0) / area.sum()
    if share.max() < 0.02:
        return cylinder_end(mesh)
    cap = normals @ largest[int(np.argmax(share))] > np.cos(np.radians(4.0))
    flat = vectors[cap].sum(axis=0)
    return np.asarray(flat / np.linalg.norm(flat))


def _head(points: Floats, z: Floats, origin: Floats) -> tuple[Floats, float]:
    """Return centre and radius of the sphere that fits the part farthest from the axis, in the upper half of the points."""
    height = points @ z
    offset = points - origin
    across = offset - np.outer(offset @ z, z)
    distance = np.linalg.norm(across, axis=1)
    upper = height > height.max() - 4.0 * float(distance[height > np.median(height)].max())
    far = int(np.argmax(np.where(upper, distance, 0.0)))
    reach = float(distance[far])
    direction = across[far] / reach
    head = upper & (across @ direction > 0.62 * reach)
    for _ in range(4):
        rows = np.column_stack([2.0 * points[head], np.ones(int(head.sum()))])
        solution = np.linalg.lstsq(rows, (points[head] ** 2).sum(axis=1), rcond=None)[0]
        center = solution[:3]
        radius = float(np.sqrt(max(solution[3] + center @ center, 0.0)))
        head = (np.abs(np.linalg.norm(points - center, axis=1) - radius) < 0.12 * radius) & (
            (points - center) @ direction > -0.2 * radius
        )
        if head.sum() < 20:
            raise GeometryError("no femoral head found beside the shaft", _REFUSED)
    offset_of_head = float(np.linalg.norm(np.cross(center - origin, z)))
    if not 0.25 < radius / reach < 0.7 or offset_of_head < radius:
        raise GeometryError(
            f"no femoral head found: the sphere beside the shaft has a radius of {radius:.1f} mm and lies {offset_of_head:.1f} mm "
            "off the axis",
            _REFUSED,
        )
    return center, radius


def _lowest_bulge(
    mesh: TriMesh,
    points: Floats,
    z: Floats,
    origin: Floats,
    head: Floats,
    radius: float,
    diameter: float,
    n_angles: int = 72,
) -> tuple[Floats, float]:
    """Return the apex of the lesser trochanter and its height over its surroundings."""
    to_head = head - origin
    medial = to_head - (to_head @ z) * z
    medial /= np.linalg.norm(medial)
    frame = np.array([medial, np.cross(z, medial)])
    top = float(head @ z)
    bottom = max(float((points @ z).min()), top - 5.0 * radius)
    step = diameter / 28.0
    heights = np.arange(bottom + 0.5 * step, top, step)
    radii = np.array([_radii(mesh, z, origin, frame, h, n_angles) for h in heights])
    wrap = ("nearest", "wrap")
    smooth = gaussian_filter(radii, (2.0, 1.0), mode=wrap)
    wide = gaussian_filter(radii, (14.0, 5.0), mode=wrap)
    peak = smooth == maximum_filter(smooth, size=(25, 9), mode=wrap)
    angle = (np.arange(n_angles) + 0.5) * 360.0 / n_angles
    beside = np.abs((angle + 180.0) % 360.0 - 180.0)
    rise = smooth - wide
    within = (beside > 15.0) & (beside < 140.0)
    candidate = peak & within[None, :] & (smooth > 0.6 * diameter) & (rise > 0.01 * diameter)
    candidate[:6] = candidate[-6:] = False
    candidate[heights > top - _NEAREST * radius] = False
    rows, columns = np.nonzero(candidate)
    if len(rows) == 0:
        raise GeometryError(
            "no lesser trochanter found below the femoral head",
            "assign the role trim to a landmark, or give trim.distance_mm",
        )
    good = rise[rows, columns] >= 0.5 * rise[rows, columns].max()
    k = np.flatnonzero(good)[0]  # rows ascend: the lowest one
    row, column = int(rows[k]), int(columns[k])
    turn = np.radians(angle[column])
    across = np.array([np.cos(turn), np.sin(turn)]) @ frame
    along = origin + (heights[row] - float(origin @ z)) * z
    return along + smooth[row, column] * across, float(rise[row, column])


def _radii(mesh: TriMesh, z: Floats, origin: Floats, frame: Floats, height: float, n_angles: int) -> Floats:
    """Return the largest distance from the axis in each sector of a section, (n_angles,)."""
    ends = section_segments(mesh, z, height)
    if len(ends) == 0:
        return np.zeros(n_angles)
    flat = np.vstack([ends[:, 0], ends.mean(axis=1), ends[:, 1]]) - origin
    x, y = (flat @ frame.T).T
    sector = np.minimum((np.arctan2(y, x) / (2 * np.pi) % 1.0 * n_angles).astype(np.int64), n_angles - 1)
    radius = np.zeros(n_angles)
    np.maximum.at(radius, sector, np.hypot(x, y))
    known = np.flatnonzero(radius > 0)
    return np.asarray(np.interp(np.arange(n_angles), known, radius[known], period=n_angles))
