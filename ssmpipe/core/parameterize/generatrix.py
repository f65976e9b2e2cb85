"""The generatrix of a tube: a path from one rim to the other, along which the tube is cut open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, loop_length, split_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import corners_by_angle, rim_centroid, split_chords
from ssmpipe.core.parameterize.cutting import cut_along, shortest_path
from ssmpipe.core.parameterize.geodesic import SurfacePath, inserted, straightened
from ssmpipe.core.parameterize.seam import Seam

SNAP = 1e-3


@dataclass(frozen=True, eq=False)
class CutTube:
    """A tube that was cut open.

    Attributes
    ----------
    mesh : TriMesh
        The disk that results.
    seam : Seam
        From opening 1 (v = 0) to opening 2 (v = 1).
    length : float
        Of the seam [mm].
    """

    mesh: TriMesh
    seam: Seam
    length: float


def rims_of(
    mesh: TriMesh, openings: tuple[Floats | None, Floats | None] = (None, None), axis: Floats | None = None
) -> tuple[Ints, Ints, float]:
    """Return the two rims of a tube, opening 1 first, surface on the left of each, and how clear their order is.

    Parameters
    ----------
    mesh : TriMesh
    openings : (point, point)
        Landmarks at the rims, (3,) [mm]; one of them is enough.
    axis : (3,) float64, optional
        Without landmarks: from opening 1 to opening 2, in the aligned frame. None takes the longer rim first.

    Returns
    -------
    rim_1, rim_2 : (n,) int64
    clearness : float
        1 with landmarks; the cosine between the axis and the line from rim to rim; or by how much the lengths differ [-].

    Raises
    ------
    TopologyError
        If the surface is not a tube.
    """
    loops = boundary_loops(mesh.faces)
    if len(loops) != 2:
        remedy = (
            "close the others with fill-holes and open both ends with trim (ends: 2)"
            if len(loops) > 2
            else "open both ends with trim (ends: 2), or use a preset for surfaces with another topology"
        )
        raise TopologyError(f"the surface has {len(loops)} boundary loops, a tube has two", remedy)
    if euler_characteristic(mesh.faces) != 0:
        raise TopologyError(
            f"the surface has two boundary loops but the Euler characteristic {euler_characteristic(mesh.faces)} instead of 0",
            "let repair remove handles and loose parts",
        )
    centers = np.array([rim_centroid(mesh, loop) for loop in loops])
    line = centers[1] - centers[0]
    if any(point is not None for point in openings):
        cost = np.array([[0.0 if p is None else float(np.linalg.norm(c - p)) for c in centers] for p in openings])
        forward = cost[0, 0] + cost[1, 1] <= cost[0, 1] + cost[1, 0]
        clearness = 1.0
    elif axis is not None:
        cosine = float(line @ axis / (np.linalg.norm(line) * np.linalg.norm(axis)))
        forward, clearness = cosine >= 0, abs(cosine)
    else:
        lengths = [loop_length(mesh, loop) for loop in loops]
        forward, clearness = lengths[0] >= lengths[1], abs(float(np.log(lengths[0] / lengths[1])))
    return (loops[0], loops[1], clearness) if forward else (loops[1], loops[0], clearness)


def cut_tube(
    mesh: TriMesh,
    rims: tuple[Ints, Ints],
    *,
    through: Floats | None = None,
    side: Floats,
    path_by: Literal["edges", "geodesic"] = "edges",
) -> tuple[CutTube, float]:
    """Cut a tube open from rim to rim along a shortest path of edges (Dijkstra 1959; Li 2015, section 4.2).

    The path touches the rims in its ends only.

    Parameters
    ----------
    mesh : TriMesh
        A tube.
    rims : (rim_1, rim_2)
        As from :func:`rims_of`.
    through : (3,) float64, optional
        The path runs through the vertex nearest to this landmark, by the shortest ways to both rims [mm].
    side : (3,) float64
        Without a landmark the path joins the places of both rims that are seen from their centroids in this direction of the
        aligned frame, laid into the plane of each rim; so all patients are cut on the same side.
    path_by : {"edges", "geodesic"}
        Whether the path is straightened across the faces (:mod:`ssmpipe.core.parameterize.geodesic`), which then get new edges.

    Returns
    -------
    tube : CutTube
    clearness : float
        Smallest cosine between the direction and the plane of a rim; 1 with a landmark.

    Raises
    ------
    GeometryError
        If the landmark lies on a rim, or the direction is across both rims.
    TopologyError
        If the rims cannot be joined.
    """
    clearness, middle = 1.0, None
    if through is None:
        ends = []
        for rim in rims:
            place, cosine = rim_place(mesh, rim, side)
            clearness = min(clearness, cosine)
            mesh, vertex = insert_on_rim(mesh, rim, place)
            ends.append(vertex)
        mesh = split_chords(mesh)
        on_rims = np.concatenate(boundary_loops(mesh.faces))
        path = shortest_path(mesh, ends[0], np.array(ends[1:]), np.setdiff1d(on_rims, ends))
    else:
        mesh = split_chords(mesh)
        middle = int(np.argmin(np.linalg.norm(mesh.vertices - through, axis=1)))
        if np.isin(middle, np.concatenate(rims)):
            x, y, z = through
            raise GeometryError(
                f"the landmark of the role seam at ({x:.1f}, {y:.1f}, {z:.1f}) mm falls on a rim of the tube",
                "place it between the two openings, or remove input.roles.seam to let the direction decide",
            )
        down = shortest_path(mesh, middle, rims[0], rims[1])
        up = shortest_path(mesh, middle, rims[1], np.union1d(rims[0], down[1:]))
        path = np.concatenate([down[::-1], up[1:]])
    if path_by == "geodesic":
        mesh, path = _straight(mesh, path, middle)
    opened = cut_along(mesh, path)
    length = float(edge_lengths(mesh, np.column_stack([path[:-1], path[1:]])).sum())
    return CutTube(opened.mesh, Seam("tube", opened.pairs), length), clearness


def _straight(mesh: TriMesh, path: Ints, middle: int | None) -> tuple[TriMesh, Ints]:
    """Straighten a path, on both sides of its middle; where there is one, the ends slide along the rims to shorten it."""
    if middle is None:
        return inserted(mesh, straightened(mesh, path))
    at = int(np.flatnonzero(path == middle)[0])
    down, up = (_nearest_on_rim(mesh, part) for part in (path[at::-1], path[at:]))
    joined = SurfacePath(
        np.concatenate([down.edges[::-1], up.edges[1:]]),
        np.concatenate([down.fraction[::-1], up.fraction[1:]]),
        down.length + up.length,
    )
    return inserted(mesh, joined)


def _nearest_on_rim(mesh: TriMesh, path: Ints) -> SurfacePath:
    """Return the geodesic to the vertex of the rim, near the end of a path, that is nearest to its start."""
    best = straightened(mesh, path)
    rim = next(loop for loop in boundary_loops(mesh.faces) if path[-1] in loop)
    others = np.setdiff1d(np.concatenate(boundary_loops(mesh.faces)), rim)
    place = int(np.flatnonzero(rim == path[-1])[0])
    for step in (1, -1):
        while True:
            end = int(rim[(place + step) % len(rim)])
            forbidden = np.union1d(np.setdiff1d(rim, end), others)
            try:
                other = straightened(mesh, shortest_path(mesh, int(path[0]), np.array([end]), forbidden))
            except TopologyError:
                break
            if other.length >= best.length:
                break
            best, place = other, place + step
    return best


def rim_place(mesh: TriMesh, rim: Ints, side: Floats) -> tuple[Floats, float]:
    """Return the place of a rim on a side of its centroid, (3,) [mm], and the cosine between the side and the plane of the rim.

    Raises
    ------
    GeometryError
        If the side is across the plane of the rim.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> pipe = tube(2.0)
    >>> rim_place(pipe, boundary_loops(pipe.faces)[0], np.array([0.0, 3.0, 0.0]))[0].round(6) + 0.0
    array([0., 2., 0.])
    """
    start, end = mesh.vertices[rim], mesh.vertices[np.roll(rim, -1)]
    center = rim_centroid(mesh, rim)
    normal = np.cross(start - center, end - center).sum(axis=0)
    normal /= np.linalg.norm(normal)
    unit = side / np.linalg.norm(side)
    flat = unit - (unit @ normal) * normal
    cosine = float(np.linalg.norm(flat))
    if cosine < 1e-3:
        raise GeometryError(
            "the direction of the seam runs along the tube at one of its rims",
            "choose cut.seam_direction across the tube",
        )
    flat /= cosine
    axes = np.stack([flat, np.cross(normal, flat)])
    return corners_by_angle(mesh, rim, (0.0,), axes)[0], cosine


def insert_on_rim(mesh: TriMesh, rim: Ints, place: Floats) -> tuple[TriMesh, int]:
    """Make the place of a rim that is nearest to a point a vertex; return the mesh and the vertex.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(3)
    >>> finer, vertex = insert_on_rim(square, boundary_loops(square.faces)[0], np.array([0.2, -1.0, 0.0]))
    >>> finer.vertices[vertex]
    array([0.2, 0. , 0. ])
    """
    start, side = mesh.vertices[rim], mesh.vertices[np.roll(rim, -1)] - mesh.vertices[rim]
    t = np.clip(np.einsum("ij,ij->i", place - start, side) / np.einsum("ij,ij->i", side, side), 0.0, 1.0)
    edge = int(np.argmin(np.linalg.norm(start + t[:, None] * side - place, axis=1)))
    if t[edge] <= SNAP or t[edge] >= 1.0 - SNAP:
        return mesh, int(rim[(edge + int(t[edge] > 0.5)) % len(rim)])
    ends = np.array([[rim[edge], rim[(edge + 1) % len(rim)]]])
    return split_edges(mesh, ends, (start[edge] + t[edge] * side[edge])[None]), mesh.n_vertices
