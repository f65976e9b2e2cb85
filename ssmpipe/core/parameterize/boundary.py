"""Four corners on the rim of a disk, and the rim laid around the unit square."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.topology import boundary_loops, split_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh

_LEAST_GAP = 0.03
SQUARE_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def rim_of(mesh: TriMesh) -> Ints:
    """Return the one boundary loop of a disk, surface on the left.

    Raises
    ------
    TopologyError
        If the mesh does not have exactly one.
    """
    loops = boundary_loops(mesh.faces)
    if len(loops) != 1:
        raise TopologyError(
            f"the surface has {len(loops)} boundary loops, a map to the square needs exactly one",
            "trim the surface first" if not loops else "close the other openings in the segmentation",
        )
    return loops[0]


def rim_centroid(mesh: TriMesh, rim: Ints) -> Floats:
    """Return the arc-length weighted centroid of a loop, (3,) [mm]."""
    start, end = mesh.vertices[rim], mesh.vertices[np.roll(rim, -1)]
    length = np.linalg.norm(end - start, axis=1)
    return np.asarray(length @ (0.5 * (start + end)) / length.sum())


def rim_axes(mesh: TriMesh, rim: Ints) -> tuple[Floats, float]:
    """Return the two principal axes of a loop as rows (longer first), and the ratio of their extents.

    Their signs follow the coordinate frame: the largest component of each is positive.
    """
    middle = 0.5 * (mesh.vertices[rim] + mesh.vertices[np.roll(rim, -1)]) - rim_centroid(mesh, rim)
    length = np.linalg.norm(mesh.vertices[rim] - mesh.vertices[np.roll(rim, -1)], axis=1)
    variances, vectors = np.linalg.eigh((middle * length[:, None]).T @ middle)
    axes = vectors[:, ::-1].T[:2]
    signs = np.sign(np.take_along_axis(axes, np.argmax(np.abs(axes), axis=1)[:, None], axis=1))
    return axes * signs, float(np.sqrt(variances[2] / variances[1]))


def aligned_axes(mesh: TriMesh, rim: Ints) -> tuple[Floats, float]:
    """Return two axes in the plane of a loop that follow the coordinate frame, so that aligned shapes get the same ones.

    The frame axis nearest to the loop's normal is turned onto the normal by the shortest way; the other two go with it.

    Returns
    -------
    axes : (2, 3) float64
        Orthonormal rows.
    margin : float
        By how much the nearest frame axis is nearer than the next (difference of the cosines); near zero the choice is
        arbitrary.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(4)
    >>> axes, margin = aligned_axes(square, rim_of(square))
    >>> bool(np.allclose(axes, np.eye(3)[:2])), margin
    (True, 1.0)
    """
    start = mesh.vertices[rim] - rim_centroid(mesh, rim)
    normal = np.cross(start, np.roll(start, -1, axis=0)).sum(axis=0)
    normal /= np.linalg.norm(normal)
    nearness = np.abs(normal)
    k = int(np.argmax(nearness))
    pole = np.sign(normal[k]) * np.eye(3)[k]
    first = np.eye(3)[(k + 1) % 3]
    # the shortest rotation from the pole to the normal, applied to the next frame axis
    turned = first - (first @ normal) / (1.0 + pole @ normal) * (pole + normal)
    others = np.sort(nearness)
    return np.stack([turned, np.cross(normal, turned) * np.sign(normal[k])]), float(others[2] - others[1])


def corners_by_angle(mesh: TriMesh, rim: Ints, angles_deg: Sequence[float], axes: Floats) -> Floats:
    """Return the places on a loop seen from its centroid under the given angles, (n, 3) [mm].

    Parameters
    ----------
    mesh : TriMesh
    rim : (n_rim,) int64
    angles_deg : sequence of float
        Measured from the first to the second axis [degrees].
    axes : (2, 3) float64
        Orthonormal; the loop is looked at in their plane. Where a ray meets the loop several times, the outermost place
        counts.

    Raises
    ------
    GeometryError
        If a ray misses the loop (its centroid lies outside of it).
    """
    flat = (mesh.vertices[rim] - rim_centroid(mesh, rim)) @ axes.T
    following = np.roll(flat, -1, axis=0)
    places = []
    for angle in np.radians(np.asarray(angles_deg, dtype=np.float64)):
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        side, next_side = flat @ across, following @ across
        crossing = (side <= 0) != (next_side <= 0)
        t = np.where(crossing, side / np.where(crossing, side - next_side, 1.0), 0.0)
        reach = np.where(crossing, (1 - t) * (flat @ along) + t * (following @ along), -np.inf)
        k = int(np.argmax(reach))
        if not reach[k] > 0:
            raise GeometryError(
                f"no place of the boundary lies under {np.degrees(angle):.0f} degrees from its centroid",
                "assign landmarks to the roles corner_1 to corner_4",
            )
        places.append((1 - t[k]) * mesh.vertices[rim[k]] + t[k] * mesh.vertices[np.roll(rim, -1)[k]])
    return np.array(places)


def rim_fractions(mesh: TriMesh, rim: Ints, points: Floats) -> Floats:
    """Return where on a loop the places nearest to (n, 3) points lie, as shares of its length from its first vertex on."""
    start, side = mesh.vertices[rim], np.roll(mesh.vertices[rim], -1, axis=0) - mesh.vertices[rim]
    length = np.linalg.norm(side, axis=1)
    t = np.clip(np.einsum("pnd,nd->pn", points[:, None] - start, side) / length**2, 0.0, 1.0)
    edge = np.linalg.norm(start + t[..., None] * side - points[:, None], axis=2).argmin(axis=1)
    before = np.concatenate([[0.0], np.cumsum(length)])
    return np.asarray((before[edge] + t[np.arange(len(points)), edge] * length[edge]) / before[-1])


def places_on_rim(mesh: TriMesh, rim: Ints, fractions: Floats) -> Floats:
    """Return the (n, 3) places of a loop at shares of its length from its first vertex on, any whole number more or less."""
    closed = mesh.vertices[np.append(rim, rim[0])]
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    wanted = np.mod(fractions, 1.0) * at[-1]
    return np.stack([np.interp(wanted, at, closed[:, k]) for k in range(3)], axis=1)


def follow_each_other(fractions: Floats) -> bool:
    """Say whether four places follow each other along a loop, in either sense, none nearer to the next than 3 % of its length.

    Examples
    --------
    >>> follow_each_other(np.array([0.9, 0.1, 0.4, 0.7])), follow_each_other(np.array([0.7, 0.4, 0.1, 0.9]))
    (True, True)
    >>> follow_each_other(np.array([0.9, 0.4, 0.1, 0.7])), follow_each_other(np.array([0.1, 0.11, 0.5, 0.7]))
    (False, False)
    """
    steps = np.mod(np.roll(fractions, -1) - fractions, 1.0)
    forward = np.isclose(steps.sum(), 1.0)
    gaps = steps if forward else 1.0 - steps
    return bool(np.isclose(gaps.sum(), 1.0) and gaps.min() > _LEAST_GAP)


def corners_of_any_rim(mesh: TriMesh, rim: Ints, angles_deg: Sequence[float], axes: Floats) -> tuple[Floats, bool]:
    """Return :func:`corners_by_angle`, or quarters of the length where a loop bends too much for that, and whether it did.

    The quarters begin at the place that lies farthest under the first angle.

    Returns
    -------
    places : (4, 3) float64
        [mm].
    quarters : bool
    """
    try:
        places = corners_by_angle(mesh, rim, angles_deg, axes)
        if follow_each_other(rim_fractions(mesh, rim, places)):
            return places, False
    except GeometryError:
        pass  # a ray misses the loop
    first, second = np.radians(angles_deg[0]), np.radians(angles_deg[1])
    flat = mesh.vertices[rim] @ axes.T
    start = rim_fractions(mesh, rim, mesh.vertices[rim[[int(np.argmax(flat @ [np.cos(first), np.sin(first)]))]]])[0]
    quarters = np.array([0.0, 0.25, 0.5, 0.75])
    # in the sense in which the angles rise, as the area that the loop encloses in the plane of the axes tells
    following = np.roll(flat, -1, axis=0)
    turns_left = (flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]).sum() > 0
    sense = 1.0 if turns_left == (np.sin(second - first) > 0) else -1.0
    return places_on_rim(mesh, rim, start + sense * quarters), True


def insert_corners(mesh: TriMesh, points: Floats, snap: float = 1e-3) -> tuple[TriMesh, Ints, Floats]:
    """Make the places of the rim nearest to the given points vertices.

    Parameters
    ----------
    mesh : TriMesh
        A disk.
    points : (n, 3) float64
        Wanted corners.
    snap : float
        A vertex nearer than this share of the boundary edge's length is used as it is.

    Returns
    -------
    mesh : TriMesh
        With up to n more vertices at the end.
    corners : (n,) int64
        Vertex indices, in the order of ``points``.
    distances : (n,) float64
        From each wanted point to its corner [mm].
    """
    corners = np.empty(len(points), dtype=np.int64)
    distances = np.empty(len(points))
    for k, point in enumerate(points):
        rim = rim_of(mesh)
        start, end = mesh.vertices[rim], mesh.vertices[np.roll(rim, -1)]
        side = end - start
        t = np.clip(np.einsum("ij,ij->i", point - start, side) / np.einsum("ij,ij->i", side, side), 0.0, 1.0)
        nearest = start + t[:, None] * side
        away = np.linalg.norm(nearest - point, axis=1)
        edge = int(np.argmin(away))
        distances[k] = away[edge]
        if t[edge] <= snap or t[edge] >= 1 - snap:
            corners[k] = rim[(edge + int(t[edge] > 0.5)) % len(rim)]
        else:
            corners[k] = mesh.n_vertices
            mesh = split_edges(mesh, np.array([[rim[edge], rim[(edge + 1) % len(rim)]]]), nearest[edge][None])
    return mesh, corners, distances


def split_chords(mesh: TriMesh) -> TriMesh:
    """Divide inner edges that join two boundary vertices at their middle.

    Such an edge between two vertices of the same side of the square would be squashed onto the side.
    """
    edges = unique_edges(mesh.faces)
    on_rim = np.zeros(mesh.n_vertices, dtype=bool)
    on_rim[edges.vertices[edges.n_faces == 1]] = True
    chords = edges.vertices[(edges.n_faces == 2) & on_rim[edges.vertices].all(axis=1)]
    return split_edges(mesh, chords, mesh.vertices[chords].mean(axis=1))


def order_corners(rim: Ints, corners: Ints) -> Ints:
    """Return the corners in the direction of the rim, starting with the first; ``corner_3`` stays opposite.

    Raises
    ------
    GeometryError
        If two corners fall on the same vertex, or 1 and 3 are neighbours.
    """
    if len(np.unique(corners)) < 4:
        raise GeometryError("two corners fall on the same boundary vertex", "move the corner landmarks apart")
    place = {int(v): k for k, v in enumerate(rim)}
    after_first = np.array([(place[int(c)] - place[int(corners[0])]) % len(rim) for c in corners])
    ordered = corners[np.argsort(after_first)]
    if ordered[2] != corners[2]:
        raise GeometryError(
            "the corners do not follow each other around the boundary",
            "name them corner_1 to corner_4 in the order along the rim",
        )
    return ordered


def square_boundary(mesh: TriMesh, corners: Ints) -> tuple[Ints, Floats]:
    """Lay the rim around the unit square, by arc length between the corners.

    Parameters
    ----------
    mesh : TriMesh
        A disk.
    corners : (4,) int64
        Rim vertices in the direction of the rim (surface on the left): they go to (0, 0), (1, 0), (1, 1), (0, 1).

    Returns
    -------
    rim : (n_rim,) int64
        From the first corner on.
    uv : (n_rim, 2) float64
        Counter-clockwise; the corners exact.
    """
    rim = rim_of(mesh)
    rim = np.roll(rim, -int(np.flatnonzero(rim == corners[0])[0]))
    uv = np.empty((len(rim), 2))
    at = [int(np.flatnonzero(rim == c)[0]) for c in corners] + [len(rim)]
    closed = np.append(rim, rim[0])
    for k in range(4):
        piece = mesh.vertices[closed[at[k] : at[k + 1] + 1]]
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(piece, axis=0), axis=1))])
        t = (arc / arc[-1])[:-1, None]
        uv[at[k] : at[k + 1]] = (1 - t) * SQUARE_CORNERS[k] + t * SQUARE_CORNERS[(k + 1) % 4]
    return rim, uv
