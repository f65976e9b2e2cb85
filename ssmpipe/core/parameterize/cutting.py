"""Cut a surface open along a path of edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.topology import unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh


@dataclass(frozen=True, eq=False)
class Opened:
    """A surface that was cut along a path.

    Attributes
    ----------
    mesh : TriMesh
        The vertices of the uncut mesh in their order, then the right copies of the path's inner vertices.
    origin : (n_vertices,) int64
        Vertex of the uncut mesh, for each vertex of the cut one.
    pairs : (n_pairs, 2) int64
        Left and right copies along the path, seen from outside with the path running up: the left copy bounds what lies to the
        right of the path, where u begins.
    """

    mesh: TriMesh
    origin: Ints
    pairs: Ints


def shortest_path(mesh: TriMesh, start: int, targets: Ints, forbidden: Ints) -> Ints:
    """Return the shortest path of edges from ``start`` to the nearest of ``targets``, as vertices (Dijkstra 1959).

    Edges between two of the targets are not used, so that the path touches them in its end only.

    Raises
    ------
    TopologyError
        If every way leads over a forbidden vertex.
    """
    edges = unique_edges(mesh.faces).vertices
    closed = np.zeros(mesh.n_vertices, dtype=bool)
    closed[forbidden] = True
    goal = np.zeros(mesh.n_vertices, dtype=bool)
    goal[targets] = True
    edges = edges[~closed[edges].any(axis=1) & ~goal[edges].all(axis=1)]
    i, j = edges.T
    length = edge_lengths(mesh, edges)
    # no way out of a target
    outward = np.concatenate([~goal[i], ~goal[j]])
    rows, columns = np.concatenate([i, j])[outward], np.concatenate([j, i])[outward]
    graph = sparse.csr_matrix((np.tile(length, 2)[outward], (rows, columns)), shape=(mesh.n_vertices,) * 2)
    distance, before = csgraph.dijkstra(graph, indices=start, return_predecessors=True)
    end = int(targets[np.argmin(distance[targets])])
    if not np.isfinite(distance[end]):
        raise TopologyError(
            "no path of edges joins the two ends of the seam", "decimate less, or move the landmarks of the ends apart"
        )
    path = [end]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def cut_along(mesh: TriMesh, path: Ints, fixed: tuple[int, ...] = ()) -> Opened:
    """Double the vertices of a path, so that the surface opens along it.

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold.
    path : (n,) int64
        Vertices joined by inner edges; only the first and the last one may lie on the boundary.
    fixed : tuple of int
        Ends of the path that stay single: inner vertices, the poles.

    Returns
    -------
    Opened

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> opened = cut_along(tube(n_around=6, n_along=3), np.array([0, 1, 2]))
    >>> opened.mesh.n_vertices, opened.pairs.tolist()
    (21, [[0, 18], [1, 19], [2, 20]])
    """
    doubled = path[~np.isin(path, fixed)]
    on_path = np.zeros(mesh.n_vertices, dtype=bool)
    on_path[doubled] = True
    follower = np.full(mesh.n_vertices, -1)
    follower[path[:-1]] = path[1:]
    # the corners at a vertex hang together across the edges that are not cut
    corner = np.arange(3 * mesh.n_faces).reshape(-1, 3)
    half = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2)
    cut = (follower[half[..., 0]] == half[..., 1]) | (follower[half[..., 1]] == half[..., 0])
    start, end = half[..., 0][~cut], half[..., 1][~cut]
    at_start, at_end = corner[~cut], np.roll(corner, -1, axis=1)[~cut]
    n = mesh.n_vertices
    # one node for each uncut edge and end; the corners of both its faces join it
    key = np.minimum(start, end) * n + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    low = 2 * edge + (start > end)
    high = 2 * edge + (start < end)
    touched = np.concatenate([np.column_stack([at_start, low]), np.column_stack([at_end, high])])
    touched = touched[on_path[mesh.faces.ravel()[touched[:, 0]]]]
    size = 3 * mesh.n_faces + 2 * (int(edge.max()) + 1)
    graph = sparse.coo_matrix(
        (np.ones(len(touched)), (touched[:, 0], 3 * mesh.n_faces + touched[:, 1])), shape=(size, size)
    )
    group = csgraph.connected_components(graph, directed=False)[1][: 3 * mesh.n_faces].reshape(-1, 3)
    # faces to the left of the path run along it; they get the right copies
    left_of_path = follower[half[..., 0]] == half[..., 1]
    is_right = np.zeros(int(group.max()) + 1, dtype=bool)
    is_right[group[left_of_path]] = True
    is_right[np.roll(group, -1, axis=1)[left_of_path]] = True
    copy = np.arange(n)
    copy[doubled] = n + np.arange(len(doubled))
    moved = is_right[group] & on_path[mesh.faces]
    opened = TriMesh(np.vstack([mesh.vertices, mesh.vertices[doubled]]), np.where(moved, copy[mesh.faces], mesh.faces))
    return Opened(opened, np.concatenate([np.arange(n), doubled]), np.column_stack([doubled, copy[doubled]]))
