"""Remove faces without area, and leave the surface and its topology as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.mesh.numbering import canonical_order
from ssmpipe.core.mesh.operators import face_to_vertex
from ssmpipe.core.mesh.topology import compact
from ssmpipe.core.mesh.trimesh import TriMesh

FLAT = 1e-6
"""A face whose height over its longest side is no more than this share of that side has no area but for rounding [-]."""

NEEDLE = 10 * FLAT
"""A flat face with a side no longer than this share of its longest one is a needle; flipped, it would leave another one [-]."""

_OUTSIDE = -1
"""Stands for a vertex beyond the boundary, joined to every boundary vertex."""


def flat_faces(mesh: TriMesh) -> Bools:
    """Say which faces have no area but for rounding, (n_faces,).

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0.4, 1e-7, 0], [0.4, 1e-5, 0]])
    >>> flat_faces(TriMesh(corners, np.array([[0, 1, 2], [0, 1, 3]])))
    array([ True, False])
    """
    return _measure(mesh.vertices[mesh.faces]).flat


class FlatFacesRemoved(NamedTuple):
    """A surface without flat faces, how many there were, and how many could not be removed."""

    mesh: TriMesh
    n_before: int
    n_left: int


def remove_flat_faces(mesh: TriMesh) -> FlatFacesRemoved:
    """Remove faces without area.

    The two nearest vertices of a needle become one, where that changes no topology (link condition, Dey et al. 1999) and turns
    no other face over. The longest side of any other flat face, on which its third vertex lies, is flipped to join that vertex
    to the opposite one of the face beyond; on a boundary the face is dropped. This is repeated as long as it helps.

    (``meshing_remove_t_vertices`` of PyMeshLab 2025.7 moves such vertices to the ends of the side by ``Edge Collapse``, and pinches
    necks of three edges; by ``Edge Flip`` it leaves the faces on a boundary. ``collapse_small_triangles`` of libigl does
    not look at the topology.)

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold.

    Returns
    -------
    FlatFacesRemoved
        The same object where no face is removed; otherwise of the same topology, untouched faces and vertices in their order.
        Vertices move by no more than NEEDLE of a side.

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1, 0], [1, -1, 0.0]])
    >>> square = TriMesh(corners, np.array([[0, 2, 3], [2, 1, 3], [0, 1, 2], [1, 0, 4]]))
    >>> remove_flat_faces(square).mesh.faces.tolist()
    [[0, 2, 3], [2, 1, 3], [2, 0, 4], [4, 1, 2]]
    """
    flat = np.flatnonzero(flat_faces(mesh))
    if len(flat) == 0:
        return FlatFacesRemoved(mesh, 0, 0)
    surgery = _Surgery(mesh)
    left = set(flat.tolist())
    changed = True
    while changed:
        changed = False
        for face in sorted(left, key=surgery.rank):
            if face in left and (touched := surgery.treat(face)):
                changed = True
                left = (left - touched) | surgery.flat_among(touched)
    if len(left) >= len(flat):
        return FlatFacesRemoved(mesh, len(flat), len(flat))
    return FlatFacesRemoved(surgery.result(), len(flat), len(left))


class _Measure(NamedTuple):
    sides: Floats
    vector: Floats
    flat: Bools


def _measure(corners: Floats) -> _Measure:
    """Return lengths of sides (n, 3), the first from corner 0 to 1, doubled area vectors (n, 3), and which faces are flat (n,)."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return _Measure(sides, vector, np.linalg.norm(vector, axis=1) <= FLAT * sides.max(axis=1) ** 2)


class _Surgery:
    """A mesh of which some faces change; what is asked for is looked up, the rest is not touched."""

    def __init__(self, mesh: TriMesh) -> None:
        self.mesh = mesh
        self.vertices = mesh.vertices.copy()
        self.faces: dict[int, tuple[int, int, int] | None] = {}
        self._incidence = face_to_vertex(mesh)
        self._around: dict[int, set[int]] = {}
        order, _ = canonical_order(mesh)
        self._rank = np.empty(mesh.n_vertices, dtype=np.int64)
        self._rank[order] = np.arange(mesh.n_vertices)

    def rank(self, face: int) -> list[int]:
        """Return what orders faces alike in every pose and numbering."""
        return sorted(self._rank[list(self.corners(face))].tolist())

    def corners(self, face: int) -> tuple[int, int, int]:
        corners = self.faces[face] if face in self.faces else tuple(self.mesh.faces[face].tolist())
        assert corners is not None
        return corners

    def around(self, vertex: int) -> set[int]:
        """Return the faces at a vertex."""
        if vertex not in self._around:
            start, stop = self._incidence.indptr[vertex : vertex + 2]
            self._around[vertex] = set(self._incidence.indices[start:stop].tolist())
        return self._around[vertex]

    def flat_among(self, faces: set[int]) -> set[int]:
        kept = [face for face in faces if self.faces.get(face, ()) is not None]
        flat = self.measure([self.corners(face) for face in kept]).flat
        return {face for face, is_flat in zip(kept, flat, strict=True) if is_flat}

    def measure(self, faces: list[tuple[int, int, int]]) -> _Measure:
        return _measure(self.vertices[np.array(faces, dtype=np.int64).reshape(-1, 3)])

    def result(self) -> TriMesh:
        faces, keep = self.mesh.faces.copy(), np.ones(self.mesh.n_faces, dtype=bool)
        for face, corners in self.faces.items():
            keep[face] = corners is not None
            faces[face] = faces[face] if corners is None else corners
        return compact(TriMesh(self.vertices, faces), keep)

    def treat(self, face: int) -> set[int]:
        """Remove a flat face if possible; return which faces changed, none if it is not."""
        corners = self.corners(face)
        sides = self.measure([corners]).sides[0]
        shortest, longest = int(sides.argmin()), int(sides.argmax())
        touched: set[int] = set()
        if sides[shortest] <= NEEDLE * sides[longest]:
            touched = self._merge(corners[shortest], corners[(shortest + 1) % 3])
        return touched or self._flip(face, *(corners[(longest + k) % 3] for k in range(3)))

    def _replace(self, face: int, corners: tuple[int, int, int] | None) -> None:
        for vertex in self.corners(face):
            self.around(vertex).discard(face)
        for vertex in corners or ():
            self.around(vertex).add(face)
        self.faces[face] = corners

    def _flip(self, face: int, p: int, q: int, r: int) -> set[int]:
        """Join r, which lies on the side from p to q, to the vertex on its other side, if that is a gain."""
        beside = (self.around(p) & self.around(q)) - {face}
        if not beside:
            return self._drop(face, p, q, r)
        (other,) = beside
        (d,) = set(self.corners(other)) - {p, q}
        if self.around(r) & self.around(d):
            return set()
        after = [(r, p, d), (d, q, r)]
        old, new = self.measure([self.corners(face), self.corners(other)]), self.measure(after)
        # fewer flat faces, or shorter ones: this comes to an end
        if not sorted(new.sides.max(axis=1)[new.flat])[::-1] < sorted(old.sides.max(axis=1)[old.flat])[::-1]:
            return set()
        if not old.flat[1] and (new.vector[~new.flat] @ old.vector[1] <= 0).any():
            return set()
        self._replace(face, after[0])
        self._replace(other, after[1])
        return {face, other}

    def _drop(self, face: int, p: int, q: int, r: int) -> set[int]:
        """Drop a face whose side from p to q is open; r comes to lie on the boundary, or the face is a whisker of it."""
        n_open = sum(len(self.around(x) & self.around(r)) == 1 for x in (p, q))
        if n_open == 2 or (n_open == 0 and _OUTSIDE in self._link(r)[0]):
            return set()
        self._replace(face, None)
        return {face}

    def _link(self, vertex: int) -> tuple[set[int], set[frozenset[int]]]:
        """Return vertices and edges opposite to a vertex, the boundary closed by a vertex outside."""
        edges = {frozenset(self.corners(face)) - {vertex} for face in self.around(vertex)}
        count: dict[int, int] = {}
        for x in (x for edge in edges for x in edge):
            count[x] = count.get(x, 0) + 1
        ends = [x for x, n in count.items() if n == 1]
        return {*count, *([_OUTSIDE] if ends else [])}, edges | {frozenset((x, _OUTSIDE)) for x in ends}

    def _merge(self, a: int, b: int) -> set[int]:
        """Make one vertex of two that an edge joins, if the topology stays and no face is turned over."""
        a, b = sorted((a, b))
        (near_a, edges_a), (near_b, edges_b) = self._link(a), self._link(b)
        between = self.around(a) & self.around(b)
        link = {x for face in between for x in self.corners(face)} - {a, b}
        if len(between) == 1:
            link.add(_OUTSIDE)
        if near_a & near_b != link or edges_a & edges_b:
            return set()
        open_a, open_b = _OUTSIDE in near_a, _OUTSIDE in near_b
        weight = 0.5 if open_a == open_b else float(open_b)
        place = (1.0 - weight) * self.vertices[a] + weight * self.vertices[b]
        moved = sorted(self.around(a) ^ self.around(b))
        before = self.measure([self.corners(face) for face in moved])
        saved = self.vertices[[a, b]]
        self.vertices[[a, b]] = place
        after = self.measure([self.corners(face) for face in moved])
        if (np.einsum("ij,ij->i", before.vector, after.vector)[~before.flat] <= 0).any():
            self.vertices[[a, b]] = saved
            return set()
        self._rank[a] = min(self._rank[a], self._rank[b])
        for face in between:
            self._replace(face, None)
        for face in sorted(self.around(b)):
            x, y, z = (a if x == b else x for x in self.corners(face))
            self._replace(face, (x, y, z))
        return {*moved, *between}
