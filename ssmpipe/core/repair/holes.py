"""The triangles of a patch that closes a boundary loop: as fine as the mesh around it, manifold by construction."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.topology import boundary_half_edges, split_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh


def check_loops(mesh: TriMesh) -> None:
    """Refuse boundary loops that touch each other or themselves.

    Raises
    ------
    TopologyError
        Names the number of such vertices and the place of the first.
    """
    half = boundary_half_edges(mesh.faces)
    leaving = np.bincount(half[:, 0], minlength=mesh.n_vertices)
    touching = np.flatnonzero(leaving > 1)
    if len(touching):
        x, y, z = mesh.vertices[touching[0]]
        raise TopologyError(
            f"boundary loops touch at {len(touching)} vertices, the first at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
            "run stage repair first: it parts what only touches",
        )


def started_by_shape(points: Floats) -> Ints:
    """Return the order (n,) that starts a closed loop at the point farthest from its middle.

    So the patch does not depend on how the vertices are numbered.
    """
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return np.roll(np.arange(len(points)), -int(np.argmax(away)))


def round_patch(lengths: Floats, spacing: float) -> tuple[Floats, Ints]:
    """Triangulate a disk whose rim has sides in the given proportions.

    The loop goes onto a circle by arc length, a hexagonal grid fills it, and the Delaunay triangulation joins them: the disk is
    convex, so it is always a valid one. A side between two vertices of the rim that is not on the rim gets a vertex in its
    middle; otherwise it might exist in the mesh already.

    Parameters
    ----------
    lengths : (n,) float64
        Length of the side from each loop vertex to the next one [mm].
    spacing : float
        Wanted distance between vertices [mm].

    Returns
    -------
    points : (n + n_inner, 2) float64
        The loop first, counter-clockwise [mm].
    faces : (n_faces, 3) int64
        Counter-clockwise.
    """
    n = len(lengths)
    # a floor keeps clusters of the marching cubes' tiny sides from degenerate triangles
    sides = np.maximum(lengths, 0.25 * lengths.mean())
    radius = float(lengths.sum()) / (2 * np.pi)
    angle = 2 * np.pi * np.r_[0.0, np.cumsum(sides)[:-1]] / sides.sum()
    rim = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    if n == 3:
        return rim, np.array([[0, 1, 2]])
    reach = int(np.ceil(radius / spacing)) + 1
    i, j = np.meshgrid(np.arange(-2 * reach, 2 * reach + 1), np.arange(-2 * reach, 2 * reach + 1), indexing="ij")
    grid = spacing * np.column_stack([(i + 0.5 * j).ravel(), (np.sqrt(0.75) * j).ravel()])
    inner = grid[np.linalg.norm(grid, axis=1) < radius - 0.6 * spacing]
    if len(inner) < 2:
        inner = np.zeros((1, 2))
        faces = np.column_stack([np.arange(n), np.roll(np.arange(n), -1), np.full(n, n)])
        return np.vstack([rim, inner]), faces
    points = np.vstack([rim, inner])
    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces = np.where((turn < 0)[:, None], faces[:, ::-1], faces)
    faces = faces[np.lexsort(np.sort(faces, axis=1).T)]
    edges = unique_edges(faces)
    chord = edges.vertices[(edges.vertices < n).all(axis=1) & (edges.n_faces == 2)]
    flat = np.column_stack([points, np.zeros(len(points))])
    split = split_edges(TriMesh(flat, faces), chord, flat[chord].mean(axis=1))
    _check_disk(split.faces, n)
    return np.array(split.vertices[:, :2]), np.array(split.faces)


def _check_disk(faces: Ints, n_rim: int) -> None:
    edges = unique_edges(faces)
    rim = edges.vertices[edges.n_faces == 1]
    if len(rim) != n_rim or rim.max() != n_rim - 1 or edges.n_faces.max() > 2:
        raise TopologyError(
            f"a boundary loop of {n_rim} vertices cannot be closed by a disk", "smooth or trim its ragged rim first"
        )


def delaunay_flips(vertices: Floats, faces: Ints, n_rim: int, n_rounds: int = 20) -> Ints:
    """Flip edges of a patch where the two angles that face an edge sum to more than half a turn.

    Edges that do not share a face are flipped at the same time. No flip joins two vertices of the rim (the first ``n_rim``)
    or makes an edge twice.
    """
    faces = np.array(faces)
    size = len(vertices)
    for _ in range(n_rounds):
        edges = unique_edges(faces)
        order = np.argsort(edges.of_face.ravel(), kind="stable")
        start = np.concatenate([[0], np.cumsum(edges.n_faces)])
        inner = np.flatnonzero(edges.n_faces == 2)
        h, g = order[start[inner]], order[start[inner] + 1]
        a, b = faces[h // 3, h % 3], faces[h // 3, (h + 1) % 3]
        c, d = faces[h // 3, (h + 2) % 3], faces[g // 3, (g + 2) % 3]
        excess = _angle(vertices, c, a, b) + _angle(vertices, d, a, b) - np.pi
        low, high = np.minimum(c, d), np.maximum(c, d)
        known = edges.vertices[:, 0] * size + edges.vertices[:, 1]
        # a flip must not turn a face over
        one, two = _normal(vertices, a, d, c), _normal(vertices, d, b, c)
        old = _normal(vertices, a, b, c) + _normal(vertices, b, a, d)
        sound = (np.einsum("ij,ij->i", one, old) > 0) & (np.einsum("ij,ij->i", two, old) > 0)
        want = (excess > 1e-6) & (high >= n_rim) & ~np.isin(low * size + high, known) & sound
        if not want.any():
            break
        best = np.argsort(-np.where(want, excess, -np.inf), kind="stable")[: int(want.sum())]
        # an edge goes first if it is the most urgent one at both of its faces, and of its new neighbours
        urgent = np.full(len(faces), len(best))
        rank = np.arange(len(best))
        np.minimum.at(urgent, h[best] // 3, rank)
        np.minimum.at(urgent, g[best] // 3, rank)
        chosen = best[(urgent[h[best] // 3] == rank) & (urgent[g[best] // 3] == rank)]
        _, once = np.unique((low * size + high)[chosen], return_index=True)
        chosen = chosen[np.sort(once)]
        faces[h[chosen] // 3] = np.column_stack([a, d, c])[chosen]
        faces[g[chosen] // 3] = np.column_stack([d, b, c])[chosen]
    return faces


def folded_share(vertices: Floats, faces: Ints) -> float:
    """Return the share of the area whose faces look away from the mean normal at their corners [-]."""
    vector = _normal(vertices, *faces.T)
    at_vertex = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(at_vertex, faces[:, k], vector)
    length = np.linalg.norm(at_vertex, axis=1, keepdims=True)
    unit = at_vertex / np.maximum(length, np.finfo(float).tiny)
    size = np.linalg.norm(vector, axis=1)
    away = np.einsum("ij,ij->i", vector, unit[faces].mean(axis=1)) < 0
    return float(size[away].sum() / size.sum()) if size.sum() > 0 else 1.0


def _normal(vertices: Floats, a: Ints, b: Ints, c: Ints) -> Floats:
    return np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])


def _angle(vertices: Floats, at: Ints, a: Ints, b: Ints) -> Floats:
    one, two = vertices[a] - vertices[at], vertices[b] - vertices[at]
    cross = np.linalg.norm(np.cross(one, two), axis=1)
    return np.asarray(np.arctan2(cross, np.einsum("ij,ij->i", one, two)))
