"""Straighten a path of edges to a geodesic that crosses faces, and make it a path of edges again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.topology import boundary_half_edges, face_neighbours, split_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh

SNAP = 1e-3
"""A geodesic that crosses an edge nearer than this share of its length to a vertex is led through the vertex [-]."""


@dataclass(frozen=True, eq=False)
class SurfacePath:
    """A path on a surface that is straight within every face.

    Attributes
    ----------
    edges : (n, 2) int64
        Edge on which each point of the path lies; a vertex is given twice.
    fraction : (n,) float64
        Place on the edge, from its first vertex to its second [-].
    length : float
        [mm]
    """

    edges: Ints
    fraction: Floats
    length: float


def straightened(mesh: TriMesh, path: Ints, max_rounds: int = 100_000) -> SurfacePath:
    """Return the geodesic to which a path of edges shrinks, between the same ends.

    The faces beside the path are unfolded into the plane, where a funnel gives the shortest line in their strip (Lee and
    Preparata 1984). Where it bends at a vertex with less than half a turn on the outer side, the strip is led around the vertex on
    that side (Xin and Wang 2007); at all such bends in one round, but for neighbours. Every round shortens the line (when several
    detours are in each other's way only the sharpest bend is led around), so this ends; no bend is left that a detour would shorten.

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold.
    path : (n,) int64
        Vertices joined by edges; only the ends may lie on the boundary.
    max_rounds : int

    Raises
    ------
    TopologyError
        If the geodesic is pressed against the boundary.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(4)
    >>> around = np.array([0, 4, 5, 9, 13, 14, 15])
    >>> bool(np.isclose(straightened(square, around).length, np.sqrt(2)))
    True
    """
    if len(path) == 2:
        return _along(mesh, path)
    neighbour = face_neighbours(mesh.faces)
    total = _angles(mesh)
    rim = np.zeros(mesh.n_vertices, dtype=bool)
    rim[boundary_half_edges(mesh.faces)] = True
    start, goal = int(path[0]), int(path[-1])
    strip = _tidied(mesh, _strip(mesh, neighbour, path), start, goal)
    shortest, before, turned = np.inf, strip, [start]
    for _ in range(max_rounds):
        portals = _portals(mesh, neighbour, strip)
        flat, ends = _unfolded(mesh, portals, start, goal)
        bends = _funnel(flat, portals, ends)
        corners = [ends[0], *(flat[k][side] for k, side in bends), ends[1]]
        length = float(np.abs(np.diff(corners)).sum())
        if length >= shortest and len(turned) > 1:
            turned = turned[:1]
            strip = _tidied(mesh, _around(mesh, neighbour, before, turned[0]), start, goal)
            continue
        shortest, before = length, strip
        turned = _shortening(bends, corners, portals, total)
        if not turned:
            return _crossings(bends, flat, portals, corners, (start, goal))
        if rim[turned[0]]:
            x, y, z = mesh.vertices[turned[0]]
            raise TopologyError(
                f"the shortest line between the ends of the seam runs along the boundary at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
                "move the landmarks of the seam, or use cut.path: edges",
            )
        turned = [vertex for vertex in turned if not rim[vertex]]
        for vertex in turned:
            if vertex == turned[0] or (mesh.faces[strip] == vertex).any(axis=1).sum() > 1:
                strip = _around(mesh, neighbour, strip, vertex)
        strip = _tidied(mesh, strip, start, goal)
    raise TopologyError(
        f"the seam could not be straightened in {max_rounds} rounds", "use cut.path: edges, or decimate first"
    )


def inserted(mesh: TriMesh, line: SurfacePath, snap: float = SNAP) -> tuple[TriMesh, Ints]:
    """Make a path on the surface a path of edges: every edge that it crosses gets a vertex there.

    Parameters
    ----------
    mesh : TriMesh
    line : SurfacePath
    snap : float
        Where it crosses an edge nearer than this share of its length to an inner vertex it is led through the vertex [-].

    Returns
    -------
    mesh : TriMesh
        The same surface; the old vertices come first, then the new ones along the line.
    path : (n,) int64
        Its vertices along the line.

    Raises
    ------
    TopologyError
        If the line touches itself.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(4)
    >>> finer, path = inserted(square, straightened(square, np.array([0, 4, 5, 9, 13, 14, 15])))
    >>> bool(np.isclose(np.linalg.norm(np.diff(finer.vertices[path], axis=0), axis=1).sum(), np.sqrt(2)))
    True
    """
    rim = np.zeros(mesh.n_vertices, dtype=bool)
    rim[boundary_half_edges(mesh.faces)] = True
    a, b = line.edges.T
    t = line.fraction
    at_a = (a == b) | ((t < snap) & ~rim[a])
    at_b = ~at_a & (t > 1 - snap) & ~rim[b]
    crossing = ~at_a & ~at_b
    points = mesh.vertices[a] + t[:, None] * (mesh.vertices[b] - mesh.vertices[a])
    number = np.where(at_a, a, b)
    number[crossing] = mesh.n_vertices + np.arange(int(crossing.sum()))
    result = split_edges(mesh, line.edges[crossing], points[crossing])
    path = number[np.r_[True, number[1:] != number[:-1]]]
    known = unique_edges(result.faces).vertices
    pairs = np.sort(np.column_stack([path[:-1], path[1:]]), axis=1)
    size = result.n_vertices
    if len(np.unique(path)) < len(path) or not np.isin(pairs @ [size, 1], known @ [size, 1]).all():
        raise TopologyError("the geodesic cannot be made a path of edges", "use cut.path: edges")
    return result, path


def _along(mesh: TriMesh, path: Ints) -> SurfacePath:
    edges = np.column_stack([path, path])
    return SurfacePath(edges, np.zeros(len(path)), float(edge_lengths(mesh, path[None, :2]).sum()))


def _angles(mesh: TriMesh) -> Floats:
    """Return the sum of the angles of the faces at every vertex, (n_vertices,) [rad]."""
    total = np.zeros(mesh.n_vertices)
    for k in range(3):
        at, one, two = (mesh.vertices[mesh.faces[:, (k + m) % 3]] for m in range(3))
        cross = np.linalg.norm(np.cross(one - at, two - at), axis=1)
        angle = np.arctan2(cross, np.einsum("ij,ij->i", one - at, two - at))
        total += np.bincount(mesh.faces[:, k], weights=angle, minlength=mesh.n_vertices)
    return total


def _fan(mesh: TriMesh, neighbour: Ints, vertex: int, first: int, last: int, clockwise: bool) -> list[int]:
    """Return the faces around a vertex from ``first`` to ``last``, both included."""
    faces, at = [first], first
    while at != last:
        k = int(np.flatnonzero(mesh.faces[at] == vertex)[0])
        # a face (vertex, b, c) is followed counter-clockwise by the one across (c, vertex), clockwise across (vertex, b)
        at = int(neighbour[at, k if clockwise else (k + 2) % 3])
        if at < 0 or at == first:
            raise TopologyError(
                "the seam's path touches the boundary between its ends", "use another place for the seam"
            )
        faces.append(at)
    return faces


def _strip(mesh: TriMesh, neighbour: Ints, path: Ints) -> list[int]:
    """Return the faces to the left of a path of edges, in its order."""
    half = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2)
    size = mesh.n_vertices
    keys = (half[..., 0] * size + half[..., 1]).ravel()
    order = np.argsort(keys)
    wanted = path[:-1] * size + path[1:]
    left = order[np.searchsorted(keys[order], wanted)] // 3
    strip: list[int] = [int(left[0])]
    for k in range(1, len(path) - 1):
        strip += _fan(mesh, neighbour, int(path[k]), int(left[k - 1]), int(left[k]), clockwise=True)[1:]
    return strip


def _tidied(mesh: TriMesh, strip: list[int], start: int, goal: int) -> list[int]:
    """Leave out what a strip visits twice, and faces before the last one at the start and after the first one at the goal."""
    last = {face: k for k, face in enumerate(strip)}
    simple, k = [], 0
    while k < len(strip):
        k = last[strip[k]]
        simple.append(strip[k])
        k += 1
    at_start = np.flatnonzero((mesh.faces[simple] == start).any(axis=1))
    simple = simple[at_start[-1] :]
    at_goal = np.flatnonzero((mesh.faces[simple] == goal).any(axis=1))
    return simple[: at_goal[0] + 1]


def _portals(mesh: TriMesh, neighbour: Ints, strip: list[int]) -> Ints:
    """Return the left and right vertex of the sides between consecutive faces of a strip, (n - 1, 2)."""
    faces = np.array(strip)
    side = (neighbour[faces[:-1]] == faces[1:, None]).argmax(axis=1)
    right = mesh.faces[faces[:-1], side]
    left = mesh.faces[faces[:-1], (side + 1) % 3]
    return np.column_stack([left, right])


Flat = list[tuple[complex, complex]]
"""The left and the right end of every portal in the plane [mm]; complex numbers, because Python is fast with them."""


def _unfolded(mesh: TriMesh, portals: Ints, start: int, goal: int) -> tuple[Flat, tuple[complex, complex]]:
    """Lay a strip into the plane; return its portals and both ends."""
    v = mesh.vertices
    if len(portals) == 0:
        return [], (0j, 1j * float(np.linalg.norm(v[goal] - v[start])))
    # in front of every portal lies the vertex that is new in the next one; in front of the last the goal, behind the first the start
    moved = portals[1:] != portals[:-1]
    beyond = np.concatenate([portals[1:][moved], [goal, start]])
    left, right = v[np.concatenate([portals, portals[:1]])].transpose(1, 0, 2)
    to, side = v[beyond] - right, left - right
    width = np.linalg.norm(side, axis=1)
    x = np.einsum("ij,ij->i", to, side) / width
    height = np.sqrt(np.maximum(np.einsum("ij,ij->i", to, to) - x * x, 0.0))
    place = (x - 1j * height).tolist()
    a, b = 0j, complex(width[0])
    flat = [(a, b)]
    begin = (b + (a - b) / abs(a - b) * place[-1]).conjugate()
    for at, new_left in zip(place, moved[:, 0].tolist(), strict=False):
        c = b + (a - b) / abs(a - b) * at
        a, b = (c, b) if new_left else (a, c)
        flat.append((a, b))
    return flat, (begin, b + (a - b) / abs(a - b) * place[-2])


def _turn(a: complex, b: complex, c: complex) -> float:
    return ((b - a).conjugate() * (c - a)).imag


def _funnel(flat: Flat, portals: Ints, ends: tuple[complex, complex]) -> list[tuple[int, int]]:
    """Return the bends of the shortest line through the portals: number of the last portal with it, and side (0: left)."""
    n = len(portals)
    places = [*flat, (ends[1], ends[1])]
    number = [*portals.tolist(), [-2, -2]]
    apex = ends[0]
    bends: list[tuple[int, int]] = []
    tip, tip_id = [apex, apex], [-1, -1]
    at, apex_id, k = [-1, -1], -1, 0
    while k <= n:
        for side, sign in ((1, 1.0), (0, -1.0)):
            new, new_id = places[k][side], number[k][side]
            if sign * _turn(apex, tip[side], new) < 0 and tip_id[side] != apex_id:
                continue
            other = 1 - side
            open_ = tip_id[side] == apex_id or tip_id[other] == apex_id
            if open_ or new_id in tip_id or sign * _turn(apex, tip[other], new) < 0:
                tip[side], tip_id[side], at[side] = new, new_id, k
                continue
            # the line bends at the tip of the other side
            apex, apex_id, k = tip[other], tip_id[other], at[other]
            while k + 1 < n and number[k + 1][other] == apex_id:
                k += 1
            bends.append((k, other))
            tip, tip_id, at = [apex, apex], [apex_id, apex_id], [k, k]
            break
        k += 1
    return bends


def _shortening(bends: list[tuple[int, int]], corners: list[complex], portals: Ints, total: Floats) -> list[int]:
    """Return the vertices at which the line bends and would be shorter on the other side, no two neighbours; the sharpest first."""
    if not bends:
        return []
    way = np.diff(corners)
    inner = np.pi - np.abs(np.angle(way[1:] * way[:-1].conjugate()))
    vertices = portals[tuple(np.transpose(bends))]
    gains = np.concatenate([[0.0], 3 * np.pi - total[vertices] - inner, [0.0]])
    found = []
    for m in np.argsort(-gains, kind="stable"):
        if gains[m] > 1e-9:
            found.append(int(vertices[m - 1]))
            gains[[m - 1, m + 1]] = 0.0
    return found


def _around(mesh: TriMesh, neighbour: Ints, strip: list[int], vertex: int) -> list[int]:
    """Lead a strip around the other side of a vertex."""
    has = np.flatnonzero((mesh.faces[strip] == vertex).any(axis=1))
    first, last = int(has[0]), int(has[-1])
    if first == last:
        raise TopologyError("the seam cannot be straightened", "use cut.path: edges")
    k = int(np.flatnonzero(mesh.faces[strip[first]] == vertex)[0])
    goes_clockwise = int(neighbour[strip[first], k]) == strip[first + 1]
    fan = _fan(mesh, neighbour, vertex, strip[first], strip[last], clockwise=not goes_clockwise)
    return strip[:first] + fan + strip[last + 1 :]


def _crossings(
    bends: list[tuple[int, int]], flat: Flat, portals: Ints, corners: list[complex], ids: tuple[int, int]
) -> SurfacePath:
    """Return where the line crosses the portals."""
    number = [ids[0], *(int(portals[k, side]) for k, side in bends), ids[1]]
    edges, fraction = [(ids[0], ids[0])], [0.0]
    segment = 0
    for k, (p, q) in enumerate(portals.tolist()):
        while segment < len(bends) and k > bends[segment][0]:
            segment += 1
            edges.append((number[segment], number[segment]))
            fraction.append(0.0)
        met = number[segment : segment + 2]
        if p in met or q in met:
            continue  # it meets this portal in the bend itself
        one, two = (_turn(corners[segment], corners[segment + 1], end) for end in flat[k])
        edges.append((p, q))
        fraction.append(min(max(one / (one - two), 0.0), 1.0) if one != two else 0.5)
    for m in range(segment, len(bends)):
        edges.append((number[m + 1], number[m + 1]))
        fraction.append(0.0)
    edges.append((ids[1], ids[1]))
    fraction.append(0.0)
    return SurfacePath(np.array(edges), np.array(fraction), float(np.abs(np.diff(corners)).sum()))
