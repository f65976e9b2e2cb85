"""Edges, boundary loops, components, genus, and where a handle is."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.trimesh import TriMesh


@dataclass(frozen=True, eq=False)
class Edges:
    """Undirected edges of a face list.

    Attributes
    ----------
    vertices : (n_edges, 2)
        Smaller index first, rows sorted.
    of_face : (n_faces, 3)
        Edge from corner ``k`` to corner ``k + 1`` of each face.
    forward : (n_faces, 3) bool
        Whether the face runs along the edge from the smaller to the larger index.
    n_faces : (n_edges,)
        Number of faces at the edge: 1 on the boundary, 2 inside, more where the mesh is not a manifold.
    """

    vertices: Ints
    of_face: Ints
    forward: np.ndarray
    n_faces: Ints


def unique_edges(faces: Ints) -> Edges:
    """Number the edges of a face list.

    Examples
    --------
    >>> unique_edges(np.array([[0, 1, 2], [0, 2, 3]])).n_faces
    array([1, 2, 1, 1, 1])
    """
    half = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ordered = np.sort(half, axis=1)
    size = int(faces.max()) + 1
    keys, inverse, counts = np.unique(ordered[:, 0] * size + ordered[:, 1], return_inverse=True, return_counts=True)
    vertices = np.column_stack([keys // size, keys % size])
    return Edges(vertices, inverse.reshape(-1, 3), (half[:, 0] == ordered[:, 0]).reshape(-1, 3), counts)


def boundary_half_edges(faces: Ints) -> Ints:
    """Return the half-edges (n, 2) that belong to one face only, in the direction in which that face runs."""
    edges = unique_edges(faces)
    open_side = edges.n_faces[edges.of_face] == 1
    half = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    return half[open_side]


def boundary_loops(faces: Ints) -> list[Ints]:
    """Return the boundary loops as vertex sequences, surface on the left, longest (in vertices) first.

    Needs an oriented mesh without bow-tie vertices (``repair`` makes one).

    Examples
    --------
    >>> boundary_loops(np.array([[0, 1, 2], [0, 2, 3]]))
    [array([0, 1, 2, 3])]
    """
    half = boundary_half_edges(faces)
    if len(half) == 0:
        return []
    vertices, local = np.unique(half, return_inverse=True)
    local = local.reshape(-1, 2)
    follower = np.empty(len(vertices), dtype=np.int64)
    follower[local[:, 0]] = local[:, 1]
    graph = sparse.csr_matrix((np.ones(len(local)), (local[:, 0], local[:, 1])), shape=(len(vertices),) * 2)
    n_loops, label = csgraph.connected_components(graph, directed=False)
    loops = []
    for k in range(n_loops):
        start = int(np.flatnonzero(label == k)[0])
        loop, at = [start], int(follower[start])
        while at != start and len(loop) <= len(vertices):
            loop.append(at)
            at = int(follower[at])
        loops.append(vertices[np.array(loop)])
    return sorted(loops, key=lambda loop: (-len(loop), int(loop[0])))


def loop_length(mesh: TriMesh, loop: Ints) -> float:
    """Return the length of a closed vertex sequence [mm]."""
    return float(edge_lengths(mesh, np.column_stack([loop, np.roll(loop, -1)])).sum())


def face_components(faces: Ints) -> Ints:
    """Return the component of each face, (n_faces,); faces are joined across edges, not across single vertices.

    Components are numbered in the order of their first face.
    """
    edges = unique_edges(faces)
    n_faces, n_edges = len(faces), len(edges.vertices)
    rows = np.repeat(np.arange(n_faces), 3)
    graph = sparse.csr_matrix(
        (np.ones(3 * n_faces), (rows, n_faces + edges.of_face.ravel())), shape=(n_faces + n_edges,) * 2
    )
    label = csgraph.connected_components(graph, directed=False)[1][:n_faces]
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def face_neighbours(faces: Ints) -> Ints:
    """Return the face across the side from corner k to k + 1, (n_faces, 3); -1 where there is none.

    Examples
    --------
    >>> face_neighbours(np.array([[0, 1, 2], [0, 2, 3]])).tolist()
    [[-1, -1, 1], [0, -1, -1]]
    """
    edges = unique_edges(faces)
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    start = np.concatenate([[0], np.cumsum(edges.n_faces)])
    inner = np.flatnonzero(edges.n_faces == 2)
    one, other = order[start[inner]], order[start[inner] + 1]
    result = np.full(3 * len(faces), -1)
    result[one], result[other] = other // 3, one // 3
    return result.reshape(-1, 3)


def euler_characteristic(faces: Ints) -> int:
    """Return V - E + F, counting only vertices in use: 2 for a sphere, 1 for a disk, 0 for a tube or torus."""
    return len(np.unique(faces)) - len(unique_edges(faces).vertices) + len(faces)


def genus(faces: Ints) -> int:
    """Return the number of handles of an oriented manifold mesh of one component.

    From ``chi = 2 - 2 g - n_loops``.
    """
    return (2 - len(boundary_loops(faces)) - euler_characteristic(faces)) // 2


def compact(mesh: TriMesh, keep: Ints | Bools | None = None) -> TriMesh:
    """Return the submesh of the faces ``keep`` (indices or mask; all by default), without unused vertices, in the old order."""
    faces = mesh.faces if keep is None else mesh.faces[keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    return TriMesh(mesh.vertices[used], renumbered.reshape(-1, 3))


def split_edges(mesh: TriMesh, edges: Ints, points: Floats) -> TriMesh:
    """Insert a vertex into each of the given edges and divide the faces beside it.

    Parameters
    ----------
    mesh : TriMesh
    edges : (n, 2)
        Vertex pairs, each an edge of the mesh, none twice.
    points : (n, 3)
        Positions of the new vertices; they are appended in this order.

    Returns
    -------
    TriMesh
        Same topology; a face with one, two or three divided sides becomes two, three or four faces.

    Examples
    --------
    >>> square = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    >>> split_edges(square, np.array([[2, 0]]), np.array([[0.5, 0.5, 0]])).n_faces
    4
    """
    if len(edges) == 0:
        return mesh
    size = mesh.n_vertices
    wanted = np.sort(edges, axis=1)
    keys = wanted[:, 0] * size + wanted[:, 1]
    order = np.argsort(keys)
    half = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2), axis=2)
    half_keys = half[..., 0] * size + half[..., 1]
    place = np.minimum(np.searchsorted(keys[order], half_keys), len(keys) - 1)
    hit = keys[order][place] == half_keys
    middle = np.where(hit, size + order[place], -1)
    # turn each face so that one divided side is the first, and an undivided one (of two and one) the last
    count = hit.sum(axis=1)
    turn = np.zeros(mesh.n_faces, dtype=np.int64)
    for k in range(3):
        first = hit[:, k] & ((count != 2) | hit[:, (k + 1) % 3])
        turn[first & (count > 0) & (count < 3)] = k
    index = (np.arange(3)[None, :] + turn[:, None]) % 3
    a, b, c = np.take_along_axis(mesh.faces, index, axis=1).T
    m, n, o = np.take_along_axis(middle, index, axis=1).T
    pieces = [np.column_stack([a, b, c])[count == 0]]
    for number, templates in (
        (1, [(a, m, c), (m, b, c)]),
        (2, [(m, b, n), (a, m, n), (a, n, c)]),
        (3, [(a, m, o), (m, b, n), (n, c, o), (m, n, o)]),
    ):
        pieces += [np.column_stack(t)[count == number] for t in templates]
    return TriMesh(np.vstack([mesh.vertices, points]), np.vstack(pieces))


def handle_loop(mesh: TriMesh, n_rounds: int = 4, avoid: Ints | None = None, n_generators: int = 4) -> Ints | None:
    """Find a short closed curve that does not bound: it runs around or through a handle.

    Tree-cotree decomposition (Eppstein 2003; Erickson and Whittlesey 2005): shortest paths from a root, a maximal
    spanning tree of the dual graph over the edges that are left; every edge in neither closes a generator. From the few
    shortest generators, without the way from the root to them, the search is repeated: the new root is the vertex farthest
    from the old one.

    Parameters
    ----------
    mesh : TriMesh
        Closed manifold mesh of one component.
    n_rounds : int
        Searches per generator.
    avoid : (n,) int64, optional
        Vertices that the curve passes only when there is no other way.
    n_generators : int
        Generators of the first search that are followed; two belong to every handle.

    Returns
    -------
    (n,) int64 or None
        Vertices of the loop; None when there is no handle.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import torus
    >>> ring = torus(3.0, 1.0)
    >>> round(loop_length(ring, handle_loop(ring)), 1)
    6.3
    """
    edges = unique_edges(mesh.faces)
    length = edge_lengths(mesh, edges.vertices)
    i, j = edges.vertices.T
    n = mesh.n_vertices
    if avoid is not None:
        heavy = np.zeros(n, dtype=bool)
        heavy[avoid] = True
        length = np.where(heavy[i] | heavy[j], length + length.sum(), length)
    graph = sparse.csr_matrix((np.r_[length, length], (np.r_[i, j], np.r_[j, i])), shape=(n, n))
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    inner = np.flatnonzero(edges.n_faces == 2)
    start = np.concatenate([[0], np.cumsum(edges.n_faces)])[inner]
    left, right = order[start] // 3, order[start + 1] // 3

    def loops_at(root: int) -> list[tuple[float, Ints, int]]:
        """Return length, vertices, and the vertex farthest from the root, of one loop per generator; the shortest first."""
        distance, parent = csgraph.dijkstra(graph, indices=np.array(root), return_predecessors=True)
        in_tree = (parent[i] == j) | (parent[j] == i)
        free = ~in_tree[inner]
        through = (distance[i] + distance[j] + length)[inner]
        weight = 1.0 + through.max() - through
        dual = sparse.coo_matrix((weight[free], (left[free], right[free])), shape=(mesh.n_faces,) * 2).tocsr()
        tree = csgraph.minimum_spanning_tree(dual).tocoo()
        taken = np.minimum(tree.row, tree.col).astype(np.int64) * mesh.n_faces + np.maximum(tree.row, tree.col)
        rest = free & ~np.isin(np.minimum(left, right) * mesh.n_faces + np.maximum(left, right), taken)
        loops = []
        for edge in inner[np.flatnonzero(rest)]:
            loop, meeting = _loop_through(parent.ravel().astype(np.int64), root, int(i[edge]), int(j[edge]))
            size = float(distance[i[edge]] + distance[j[edge]] + length[edge] - 2 * distance[meeting])
            loops.append((size, loop, int(loop[np.argmax(distance[loop])])))
        return sorted(loops, key=lambda found: found[0])

    best, shortest = None, np.inf
    for size, loop, root in loops_at(int(mesh.faces[0, 0]))[:n_generators]:
        if size < shortest:
            best, shortest = loop, size
        now = size
        for _ in range(n_rounds - 1):
            nearer, loop, root = loops_at(root)[0]
            if nearer >= now * (1 - 1e-9):
                break
            now = nearer
            if now < shortest:
                best, shortest = loop, now
    return best


def _loop_through(parent: Ints, root: int, a: int, b: int) -> tuple[Ints, int]:
    """Return the tree paths from a and b to where they meet, joined to a loop, and the vertex where they meet."""
    paths = []
    for at in (a, b):
        path = [at]
        while at != root:
            at = int(parent[at])
            path.append(at)
        paths.append(path)
    up, down = paths
    while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
        up, down = up[:-1], down[:-1]
    return np.array(up + down[-2::-1]), int(up[-1])


def is_edge_manifold(faces: Ints) -> bool:
    """Say whether no edge has more than two faces."""
    return bool(unique_edges(faces).n_faces.max() <= 2)


def is_manifold(faces: Ints) -> bool:
    """Say whether every edge has one or two faces and every vertex one fan of faces."""
    return is_edge_manifold(faces) and bool(np.all(igl.is_vertex_manifold(faces)[1]))
