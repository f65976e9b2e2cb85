"""Trim both ends of a tube by planes across its centre line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.centre_line import centre_line
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.narrowest_section import narrowest_section
from ssmpipe.core.mesh.operators import edge_lengths, face_areas, face_normals, mean_edge_length
from ssmpipe.core.mesh.topology import (
    boundary_loops,
    compact,
    euler_characteristic,
    face_components,
    loop_length,
    unique_edges,
)
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.mesh.tube_profile import places_on_line, point_on_line, point_on_longer_line
from ssmpipe.core.repair.cleaning import separate_fans
from ssmpipe.core.repair.extension import extend
from ssmpipe.core.repair.smoothing import taubin
from ssmpipe.core.repair.trimming import cut_by_plane


class EndPlane(NamedTuple):
    """A plane across one end of a tube: a point of it, and the unit normal that points out of the tube."""

    point: Floats
    normal: Floats


@dataclass(frozen=True, eq=False)
class TrimmedTube:
    """A tube with two planar rims.

    Attributes
    ----------
    mesh : TriMesh
        Euler characteristic 0, two loops.
    planes : tuple of EndPlane
    removed : tuple of float
        How far the old rim stood out over the plane at most [mm].
    added : tuple of float
        By how much the scan was continued to reach the plane [mm]; zero if it reached it.
    """

    mesh: TriMesh
    planes: tuple[EndPlane, EndPlane]
    removed: tuple[float, float]
    added: tuple[float, float]


def open_closed_end(mesh: TriMesh) -> TriMesh:
    """Remove the lid of a tube with one open end.

    The lid is what faces away along the centre line (by less than 45 degrees) around the place farthest from the rim.

    Raises
    ------
    TopologyError
        If no tube with two open ends is left.
    """
    (rim,) = boundary_loops(mesh.faces)
    edges = unique_edges(mesh.faces).vertices
    length = edge_lengths(mesh, edges)
    i, j = edges.T
    graph = sparse.csr_matrix((np.r_[length, length], (np.r_[i, j], np.r_[j, i])), shape=(mesh.n_vertices,) * 2)
    distance = csgraph.dijkstra(graph, indices=rim, min_only=True)
    far = int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
    line = centre_line(mesh, rim, np.array([far]))
    _, outward = point_on_line(line, _length(line) * 0.85, _length(line) * 0.2)
    facing = np.flatnonzero(face_normals(mesh) @ outward > np.cos(np.radians(45.0)))
    label = face_components(mesh.faces[facing])
    center = mesh.vertices[mesh.faces[facing]].mean(axis=1)
    lid = facing[label == label[int(np.argmin(np.linalg.norm(center - mesh.vertices[far], axis=1)))]]
    opened, _ = separate_fans(compact(mesh, np.setdiff1d(np.arange(mesh.n_faces), lid)))
    label = face_components(opened.faces)
    opened = compact(opened, label == int(np.argmax(np.bincount(label, weights=face_areas(opened)))))
    n_loops = len(boundary_loops(opened.faces))
    if n_loops < 2:
        raise TopologyError(
            "the surface has one opening, a tube needs two, and its other end has no lid that could be removed",
            "open the other end in the segmentation, or model it as femur-proximal (cone) or disk",
        )
    return opened


def opening_at(mesh: TriMesh, loops: Sequence[Ints], mark: Floats) -> int | None:
    """Return which loop a mark in or on an opening means, or None if none lies within its own diameter of it.

    Distances are those from the disc that the loop spans, so that a mark in the middle of a wide opening means that opening and no
    small hole beside it.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> pipe = tube(radius=2.0, height=10.0)
    >>> low, high = boundary_loops(pipe.faces)
    >>> opening_at(pipe, [low, high], np.array([0.5, 0, -1.0])), opening_at(pipe, [high], np.array([0, 0, 3.0])) is None
    (0, True)
    """
    best, nearest = None, np.inf
    for k, loop in enumerate(loops):
        rim = mesh.vertices[loop]
        distance = _to_disc(rim, mark)
        if distance < min(nearest, 2.0 * float(np.median(np.linalg.norm(rim - rim.mean(axis=0), axis=1)))):
            best, nearest = k, distance
    return best


def _to_disc(rim: Floats, mark: Floats) -> float:
    i = np.arange(len(rim))
    fan = np.column_stack([i, np.roll(i, -1), np.full(len(rim), len(rim))])
    return float(point_to_mesh(mark[None], TriMesh(np.vstack([rim, rim.mean(axis=0)]), fan))[0][0])


def openings(mesh: TriMesh, marks: Sequence[Floats | None]) -> tuple[Ints, Ints]:
    """Return the two rims of a tube: those that the marks mean, else the longest loops, the longer one first.

    Marks farther away than :func:`opening_at` allows, deep inside where the cut shall be, say which of the longest two is which.

    Raises
    ------
    TopologyError
        If there are fewer than two loops, or both marks lie at the same one.
    """
    loops = boundary_loops(mesh.faces)
    if len(loops) < 2:
        raise TopologyError(
            f"the surface has {len(loops)} openings, a tube needs two", "check the topology of the scan"
        )
    loops = sorted(loops, key=lambda loop: -loop_length(mesh, loop))
    meant = [None if mark is None else opening_at(mesh, loops, mark) for mark in marks]
    if meant[0] is not None and meant[0] == meant[1]:
        raise TopologyError(
            "opening_1 and opening_2 lie at the same rim", "move one of the two landmarks to the other end"
        )
    away = [[0.0 if mark is None else _to_disc(mesh.vertices[loop], mark) for loop in loops[:2]] for mark in marks]
    if meant == [None, None]:
        swapped = away[0][1] + away[1][0] < away[0][0] + away[1][1]
        meant = [1, 0] if swapped else [0, 1]
    for k, mark in enumerate(marks):
        if meant[k] is None and mark is not None:
            meant[k] = min((j for j in (0, 1) if j != meant[1 - k]), key=away[k].__getitem__)
    first = meant[0] if meant[0] is not None else int(meant[1] == 0)
    second = meant[1] if meant[1] is not None else int(first == 0)
    return loops[first], loops[second]


def planes_inside_rims(mesh: TriMesh, rims: tuple[Ints, Ints], margin: float) -> tuple[EndPlane, EndPlane]:
    """Return planes across the centre line, a margin inside the innermost point of each (ragged) rim [mm]."""
    line = centre_line(mesh, *rims)
    found = []
    for rim, inward in ((rims[0], line), (rims[1], line[::-1])):
        points = mesh.vertices[rim]
        radius = float(np.median(np.linalg.norm(points - points.mean(axis=0), axis=1)))
        at = 0.0
        for _ in range(20):
            point, tangent = point_on_line(inward, at, radius)
            inside = float(((points - point) @ tangent).max()) + margin
            if abs(inside) < 1e-9 * radius:
                break
            at = float(np.clip(at + inside, 0.0, 0.5 * _length(inward)))
        point, tangent = point_on_line(inward, at, radius)
        height = float(((points - point) @ -tangent).min()) - margin
        found.append(EndPlane(point - height * tangent, -tangent))
    return found[0], found[1]


def planes_at_fractions(
    mesh: TriMesh, rims: tuple[Ints, Ints], fractions: tuple[float, float]
) -> tuple[EndPlane, EndPlane]:
    """Return planes across the centre line at two fractions of its length, counted from the first rim."""
    line = centre_line(mesh, *rims)
    total = _length(line)
    (p, t), (q, s) = (point_on_line(line, f * total, 0.05 * total) for f in fractions)
    return EndPlane(p, -t), EndPlane(q, s)


def planes_through_points(
    mesh: TriMesh, rims: tuple[Ints, Ints], points: Sequence[Floats]
) -> tuple[EndPlane, EndPlane]:
    """Return planes in the directions of :func:`plane_across` through two points, near the first and the second rim."""
    line = centre_line(mesh, *rims)
    radius = median_radius(mesh, rims)
    planes = []
    for point, inward in ((points[0], line), (points[1], line[::-1])):
        middle, tangent = point_on_longer_line(
            inward, float(places_on_line(inward, np.asarray(point)[None])[0]), radius
        )
        planes.append(EndPlane(np.asarray(point), plane_across(mesh, middle, tangent, 2.0 * radius).normal))
    return planes[0], planes[1]


def plane_across(mesh: TriMesh, point: Floats, inward: Floats, reach: float) -> EndPlane:
    """Return the plane near an end that cuts a tube in the smallest section through a point of its centre line.

    Of the scan smoothed, since noise leaves a section no smooth minimum. Where the scan ends before that, the plane lies across the
    centre line.

    Parameters
    ----------
    mesh : TriMesh
    point : (3,) float64
    inward : (3,) float64
        Direction of the centre line there, into the tube (unit).
    reach : float
        See :func:`.narrowest_section`; about a diameter [mm].
    """
    near = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1) - point, axis=1) < 2.0 * reach
    across = narrowest_section(taubin(compact(mesh, near), n_iterations=30), point, inward, reach)
    return EndPlane(point, -(inward if across is None else across))


def median_radius(mesh: TriMesh, rims: tuple[Ints, Ints]) -> float:
    """Return the median over both rims of how far their points lie from their middles, in the median [mm]."""
    points = [mesh.vertices[rim] for rim in rims]
    return float(np.median([np.median(np.linalg.norm(p - p.mean(axis=0), axis=1)) for p in points]))


def trim_tube(
    mesh: TriMesh,
    rims: tuple[Ints, Ints],
    planes: tuple[EndPlane, EndPlane],
    *,
    extend_mm: float = 0.0,
    snap: float = 0.1,
) -> TrimmedTube:
    """Cut a tube at both ends.

    Parameters
    ----------
    mesh : TriMesh
        Genus 0; openings besides the two rims are allowed in what is removed.
    rims : (n,), (m,) int64
    planes : EndPlane, EndPlane
    extend_mm : float
        A rim that ends before its plane by no more than this is continued (see :mod:`ssmpipe.core.repair.extension`) [mm].
    snap : float
        See :func:`ssmpipe.core.repair.trimming.cut_by_plane`.

    Raises
    ------
    TopologyError
        If the scan ends before a plane, or no tube with two rims is left.
    """
    middles = [mesh.vertices[rim].mean(axis=0) for rim in rims]
    removed, added = [], []
    for middle, (point, normal), name in zip(middles, planes, ("first", "second"), strict=True):
        rim = min(
            boundary_loops(mesh.faces),
            key=lambda loop: float(np.linalg.norm(mesh.vertices[loop].mean(axis=0) - middle)),
        )
        height = (mesh.vertices[rim] - point) @ normal
        missing = -float(height.min())
        if missing > 0:
            if missing > extend_mm:
                raise TopologyError(
                    f"the scan ends {missing:.1f} mm before the plane of the {name} opening",
                    f"move the plane inward, or let the scan be continued with trim.extend_mm: {np.ceil(missing):.0f}",
                )
            margin = mean_edge_length(mesh)
            mesh = _cut_end(mesh, rim, EndPlane(point - (missing + 0.2 * margin) * normal, normal), snap)
            rim = min(
                boundary_loops(mesh.faces),
                key=lambda loop: float(np.abs((mesh.vertices[loop] - point) @ normal + missing).max()),
            )
            mesh = extend(mesh, rim, normal, 1.5 * missing + 2.0 * margin)
            rim = min(
                boundary_loops(mesh.faces),
                key=lambda loop: float(np.linalg.norm(mesh.vertices[loop].mean(axis=0) - middle)),
            )
        removed.append(float(height.max()))
        added.append(max(missing, 0.0))
        mesh = _cut_end(mesh, rim, EndPlane(point, normal), snap)
    loops = boundary_loops(mesh.faces)
    chi = euler_characteristic(mesh.faces)
    if len(loops) != 2 or chi != 0:
        lengths = ", ".join(f"{loop_length(mesh, loop):.1f}" for loop in loops[:6])
        raise TopologyError(
            f"trimming left {len(loops)} openings of {lengths} mm length and Euler characteristic {chi}; a tube has 2 and 0",
            "fill the other holes first (stage fill-holes), or move the planes",
        )
    return TrimmedTube(mesh, planes, (removed[0], removed[1]), (added[0], added[1]))


def _cut_end(mesh: TriMesh, rim: Ints, plane: EndPlane, snap: float) -> TriMesh:
    pieces, _ = separate_fans(cut_by_plane(mesh, plane.point, plane.normal, snap, around=rim))
    label = face_components(pieces.faces)
    area = np.bincount(label, weights=face_areas(pieces))
    return compact(pieces, label == int(np.argmax(area)))


def _length(line: Floats) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
