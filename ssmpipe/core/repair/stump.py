"""Find and remove the stump of a branch that was cut off, such as a coronary artery on the aorta."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import edge_lengths, face_areas, mean_edge_length
from ssmpipe.core.mesh.topology import boundary_loops, compact, face_components, loop_length, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import separate_fans

NARROW, WIDE = 1.15, 1.6
"""A stump grows by less than the first factor over half its radius; its base is where it is wider than the second [-]."""


@dataclass(frozen=True, eq=False)
class Stump:
    """What is removed: all within ``length`` [mm] of the vertices ``seeds`` (a rim, or a marked vertex), on the surface."""

    seeds: Ints
    length: float


def distance_from(mesh: TriMesh, seeds: Ints, limit: float) -> Floats:
    """Return the distance along edges from the nearest seed, infinite beyond ``limit``, (n_vertices,) [mm]."""
    # only what lies nearer in a straight line can be within the limit
    low, high = mesh.vertices[seeds].min(axis=0) - limit, mesh.vertices[seeds].max(axis=0) + limit
    near = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(axis=1)
    used, faces = np.unique(mesh.faces[near[mesh.faces].any(axis=1)], return_inverse=True)
    part = TriMesh(mesh.vertices[used], faces.reshape(-1, 3))
    edges = unique_edges(part.faces).vertices
    i, j = edges.T
    length = np.maximum(edge_lengths(part, edges), np.finfo(float).tiny)
    graph = sparse.csr_matrix((np.r_[length, length], (np.r_[i, j], np.r_[j, i])), shape=(len(used),) * 2)
    result = np.full(mesh.n_vertices, np.inf)
    result[used] = csgraph.dijkstra(graph, indices=np.searchsorted(used, seeds), min_only=True, limit=limit)
    return result


def stump_base(mesh: TriMesh, loop: Ints, reach: float) -> float | None:
    """Return the distance from a rim at which the surface around it opens, or None for a plain hole in a wall [mm].

    The girth is the length of the line at a fixed distance from the rim. In a wall it grows from the start; on a stump it
    stays, and grows where the stump meets the wall.

    Raises
    ------
    TopologyError
        If there is a stump that does not open within ``reach``.
    """
    distance = distance_from(mesh, loop, reach)
    step = mean_edge_length(_near(mesh, distance, 0.1 * reach))
    levels = np.arange(step, reach - step, 0.5 * step)
    girth = girths(mesh, distance, levels)
    radius = loop_length(mesh, loop) / (2 * np.pi)
    first = max(1, int(np.ceil(0.5 * radius / (0.5 * step))))
    if first >= len(girth) or float(np.median(girth[max(first - 2, 1) : first + 1])) > NARROW * girth[0]:
        return None
    for k in range(first, len(girth)):
        if girth[k] > WIDE * np.median(girth[:k]):
            return float(levels[k])
    x, y, z = mesh.vertices[loop].mean(axis=0)
    raise TopologyError(
        f"the stump around the hole of {loop_length(mesh, loop):.1f} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm does not open "
        f"within {reach:.0f} mm",
        "raise fill-holes.stump_reach_mm, mark it with a landmark of role stump_1 and fill-holes.stump_radius_mm, keep the hole as "
        "an opening, or close it directly with fill-holes.stumps: none",
    )


def girths(mesh: TriMesh, distance: Floats, levels: Floats) -> Floats:
    """Return the length of the lines on which ``distance`` has the given values, (n_levels,) [mm]."""
    value = distance[mesh.faces]
    known = np.isfinite(value).all(axis=1)
    faces, value = mesh.faces[known], value[known]
    order = np.argsort(value, axis=1, kind="stable")
    value = np.take_along_axis(value, order, axis=1)
    corner = mesh.vertices[np.take_along_axis(faces, order, axis=1)]
    result = np.zeros(len(levels))
    for k, level in enumerate(levels):
        cut = (value[:, 0] < level) & (level <= value[:, 2])
        low, middle, high = value[cut].T
        a, b, c = (corner[cut, m] for m in range(3))
        one = a + ((level - low) / (high - low))[:, None] * (c - a)
        below = level <= middle
        start, end = np.where(below[:, None], a, b), np.where(below[:, None], b, c)
        from_, to = np.where(below, low, middle), np.where(below, middle, high)
        two = start + ((level - from_) / np.maximum(to - from_, np.finfo(float).tiny))[:, None] * (end - start)
        result[k] = np.linalg.norm(one - two, axis=1).sum()
    return result


def remove(mesh: TriMesh, stumps: Sequence[Stump]) -> TriMesh:
    """Remove what lies within the lengths of all stumps from their seeds, on the surface, and keep the largest piece.

    Raises
    ------
    TopologyError
        If less than half of the surface is left.
    """
    rims = boundary_loops(mesh.faces)
    old_rim = np.zeros(mesh.n_vertices, dtype=bool)
    old_rim[np.concatenate(rims) if rims else []] = True
    gone = np.zeros(mesh.n_vertices, dtype=bool)
    for stump in stumps:
        gone |= np.isfinite(distance_from(mesh, stump.seeds, stump.length))
    kept = np.flatnonzero(~gone[mesh.faces].any(axis=1))
    total, share = float(face_areas(mesh).sum()), 0.0
    if len(kept):
        rest, _ = separate_fans(TriMesh(mesh.vertices, mesh.faces[kept]))
        label = face_components(rest.faces)
        part = np.bincount(label, weights=face_areas(rest))
        share = float(part.max() / total)
    if share < 0.5:
        raise TopologyError(
            f"removing {len(stumps)} stumps leaves {100 * share:.0f} % of the surface",
            "keep the true ends with fill-holes.keep_openings or landmarks, or lower fill-holes.stump_radius_mm",
        )
    old_rim = np.r_[old_rim, np.zeros(rest.n_vertices - mesh.n_vertices, dtype=bool)]
    faces = _without_ears(rest.faces[label == int(np.argmax(part))], old_rim)
    opened, _ = separate_fans(compact(TriMesh(rest.vertices, faces)))
    return opened


def _without_ears(faces: Ints, old_rim: Bools) -> Ints:
    """Drop faces with two open sides: teeth of the cut, not those of rims that were there before."""
    for _ in range(3):
        edges = unique_edges(faces)
        ear = ((edges.n_faces[edges.of_face] == 1).sum(axis=1) > 1) & ~old_rim[faces].any(axis=1)
        if not ear.any():
            break
        faces = faces[~ear]
    return faces


def _near(mesh: TriMesh, distance: Floats, limit: float) -> TriMesh:
    near = np.flatnonzero((distance[mesh.faces] < limit).any(axis=1))
    return compact(mesh, near)


def flatten(
    mesh: TriMesh,
    openings: list[Ints],
    *,
    reach: float = 25.0,
    margin: float = 1.5,
    marks: Sequence[Floats] = (),
    mark_radius: float | None = None,
    search: bool = True,
) -> tuple[TriMesh, list[Ints], list[Stump]]:
    """Remove all stumps of a surface, and return the holes that are to be closed.

    Parameters
    ----------
    mesh : TriMesh
    openings : list of (n,) int64
        Loops that stay open.
    reach : float
        Longest stump [mm].
    margin : float
        How far beyond its base a stump is cut [mm].
    marks : sequence of (3,) float64
        Places on stumps.
    mark_radius : float, optional
        Distance from a mark, on the surface, up to which all is removed; without it the loop nearest to a mark is a stump
        whose base is searched [mm].
    search : bool
        Whether loops without a mark may be stumps too.

    Returns
    -------
    mesh : TriMesh
    holes : list of (n,) int64
        The longest first; vertices of ``mesh``.
    stumps : list of Stump
        What was removed; vertices of the old mesh.

    Raises
    ------
    TopologyError
        If a marked loop is no stump, a stump does not open within reach, or its removal reaches an opening.
    """
    open_places = [mesh.vertices[loop] for loop in openings]
    holes = _others(mesh, open_places)
    holes.sort(key=lambda loop: -loop_length(mesh, loop))
    stumps: list[Stump] = []
    marked: set[int] = set()
    for mark in marks:
        if mark_radius is not None:
            seed = np.array([np.argmin(((mesh.vertices - mark) ** 2).sum(axis=1))])
            stumps.append(Stump(seed, mark_radius))
        elif holes:
            apart = [float(((mesh.vertices[loop] - mark) ** 2).sum(axis=1).min()) for loop in holes]
            marked.add(int(np.argmin(apart)))
    # all bases are found before anything is removed: a neighbour's hole would cut the girth
    for k, loop in enumerate(holes):
        if not search and k not in marked:
            continue
        base = stump_base(mesh, loop, reach)
        if base is not None:
            stumps.append(Stump(loop, base + margin))
        elif k in marked:
            x, y, z = mesh.vertices[loop].mean(axis=0)
            raise TopologyError(
                f"no widening was found around the marked hole at ({x:.1f}, {y:.1f}, {z:.1f}) mm: it lies in a wall, not on a stump",
                "give fill-holes.stump_radius_mm, or drop the landmark's role",
            )
    if not stumps:
        return mesh, holes, stumps
    result = remove(mesh, stumps)
    n_kept = len(boundary_loops(result.faces)) - len(_others(result, open_places))
    if n_kept != len(openings):
        raise TopologyError(
            f"removing {len(stumps)} stumps of up to {max(s.length for s in stumps):.1f} mm reaches an opening that shall stay",
            "lower fill-holes.stump_margin_mm or stump_radius_mm, or trim that end first",
        )
    return result, sorted(_others(result, open_places), key=lambda loop: -loop_length(result, loop)), stumps


def _others(mesh: TriMesh, places: list[Floats]) -> list[Ints]:
    loops = boundary_loops(mesh.faces)
    return [loop for loop in loops if not any(same_points(mesh.vertices[loop], place) for place in places)]


def same_points(one: Floats, other: Floats) -> bool:
    """Say whether two lists hold the same points to the bit, in any order."""
    return one.shape == other.shape and bool((one[np.lexsort(one.T)] == other[np.lexsort(other.T)]).all())
