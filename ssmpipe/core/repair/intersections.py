"""Find where a surface passes through itself, and replace the faces there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Bools, Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.topology import compact, euler_characteristic, face_components
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import separate_fans
from ssmpipe.core.repair.replacing import closed_again

MAX_RINGS = 4
"""Most rings of faces around an intersection that are replaced with it."""


@dataclass(frozen=True)
class Crossing:
    """A place where faces intersect.

    Attributes
    ----------
    place : tuple of float
        Mean of the middles of its faces [mm].
    n_faces : int
    """

    place: tuple[float, float, float]
    n_faces: int


def intersecting_pairs(mesh: TriMesh) -> Ints:
    """Return the pairs of faces that intersect other than in a common vertex or edge, (n, 2).

    Exact: boxes, then predicates of CGAL, by libigl's module under the GPL.

    Examples
    --------
    >>> v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 0.0]])
    >>> intersecting_pairs(TriMesh(v, np.array([[0, 1, 2], [3, 4, 5]]))).tolist()
    [[0, 1]]
    """
    from igl.copyleft import cgal  # large: loaded only where used

    pairs = cgal.remesh_self_intersections(np.array(mesh.vertices), np.array(mesh.faces), detect_only=True)[2]
    pairs = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0)


def crossings(mesh: TriMesh, pairs: Ints) -> list[Crossing]:
    """Gather intersecting pairs to places: faces that intersect or share a vertex belong together; the largest first.

    Examples
    --------
    >>> v = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 0.0]])
    >>> mesh = TriMesh(v, np.array([[0, 1, 2], [3, 4, 5]]))
    >>> [place.n_faces for place in crossings(mesh, intersecting_pairs(mesh))]
    [2]
    """
    if len(pairs) == 0:
        return []
    faces = np.unique(pairs)
    corner = np.column_stack([np.repeat(np.arange(len(faces)), 3), len(faces) + mesh.faces[faces].ravel()])
    links = np.vstack([corner, np.searchsorted(faces, pairs)])
    size = len(faces) + mesh.n_vertices
    graph = sparse.csr_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(size, size))
    label = csgraph.connected_components(graph, directed=False)[1][: len(faces)]
    middles = mesh.vertices[mesh.faces[faces]].mean(axis=1)
    found = []
    for k in np.unique(label):
        x, y, z = (float(c) for c in middles[label == k].mean(axis=0))
        found.append(Crossing((x, y, z), int((label == k).sum())))
    return sorted(found, key=lambda crossing: (-crossing.n_faces, crossing.place))


def repair_intersections(mesh: TriMesh) -> TriMesh:
    """Replace intersecting faces, with a few rings around them, by smooth patches, as far as that helps.

    Returns
    -------
    TriMesh
        The mesh with the fewest intersecting pairs that was met, of the same topology; the given one if nothing helps. The
        vertices away from the places stay to the bit.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> ball = sphere(10.0, 4)
    >>> vertices = ball.vertices.copy()
    >>> vertices[100] *= -1.2  # through the other side
    >>> folded = TriMesh(vertices, ball.faces)
    >>> good = repair_intersections(folded)
    >>> len(intersecting_pairs(folded)) > 0, len(intersecting_pairs(good)), euler_characteristic(good.faces)
    (True, 0, 2)
    """
    best, fewest = mesh, len(intersecting_pairs(mesh))
    for n_rings in range(1, MAX_RINGS + 1):
        if fewest == 0:
            break
        bad = np.zeros(best.n_faces, dtype=bool)
        bad[np.unique(intersecting_pairs(best))] = True
        for _ in range(n_rings):
            touched = np.zeros(best.n_vertices, dtype=bool)
            touched[best.faces[bad]] = True
            bad = np.asarray(touched[best.faces].any(axis=1))
        try:
            candidate = _replaced(best, bad)
        except (TopologyError, GeometryError):
            continue
        left = len(intersecting_pairs(candidate))
        if left < fewest:
            best, fewest = candidate, left
    return best


def _replaced(mesh: TriMesh, bad: Bools) -> TriMesh:
    """Remove faces, keep the largest piece, and close the holes that appear."""
    if bad.mean() > 0.2:
        raise TopologyError("too much of the surface intersects")
    torn, _ = separate_fans(compact(mesh, ~bad))
    label = face_components(torn.faces)
    torn = compact(torn, label == int(np.argmax(np.bincount(label))))
    return closed_again(torn, mesh, euler_characteristic(mesh.faces))
