"""Cut a surface with a plane and keep one side."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csgraph

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import adjacency, face_areas, mean_edge_length
from ssmpipe.core.mesh.topology import (
    boundary_loops,
    compact,
    euler_characteristic,
    face_components,
    loop_length,
    unique_edges,
)
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import separate_fans


def cut_by_plane(
    mesh: TriMesh, point: Floats, normal: Floats, snap: float = 0.1, around: Ints | None = None
) -> TriMesh:
    """Return the part of a mesh behind a plane (where ``(x - point) . normal < 0``), which may be several pieces.

    Parameters
    ----------
    mesh : TriMesh
    point, normal : (3,) float64
        The plane; the normal points to what is removed.
    snap : float
        Vertices nearer to the plane than this share of the mean edge length are moved onto it, which avoids slivers.
    around : (n,) int64, optional
        Vertices in front of the plane: only what is joined to them there is removed, however often the plane meets the
        rest of the surface (both legs of an arch).

    Raises
    ------
    GeometryError
        If the plane misses the mesh, or nothing lies behind it.
    """
    direction = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    height = (mesh.vertices - point) @ direction
    used = height[np.unique(mesh.faces)]
    if used.max() <= 0 or used.min() >= 0:
        side, gap = ("behind", -used.max()) if used.max() <= 0 else ("in front of", used.min())
        raise GeometryError(
            f"the plane misses the mesh: all of it lies {gap:.1f} mm or more {side} the plane", "move the plane"
        )
    height = np.where(np.abs(height) < snap * mean_edge_length(mesh), 0.0, height)
    if around is not None:
        height = _only_around(mesh, height, around)
    vertices = mesh.vertices - np.outer(np.where(height == 0.0, (mesh.vertices - point) @ direction, 0.0), direction)

    sign = np.sign(height).astype(np.int64)[mesh.faces]
    whole = (sign <= 0).all(axis=1) & (sign < 0).any(axis=1)
    crossed = (sign < 0).any(axis=1) & (sign > 0).any(axis=1)
    edges = unique_edges(mesh.faces)
    ends = height[edges.vertices]
    cut = ends[:, 0] * ends[:, 1] < 0
    t = ends[cut, 0] / (ends[cut, 0] - ends[cut, 1])
    first, second = vertices[edges.vertices[cut, 0]], vertices[edges.vertices[cut, 1]]
    new_vertices = (1.0 - t)[:, None] * first + t[:, None] * second
    new_vertices -= np.outer((new_vertices - point) @ direction, direction)
    new_index = np.full(len(cut), -1, dtype=np.int64)
    new_index[cut] = mesh.n_vertices + np.arange(int(cut.sum()))
    vertices = np.vstack([vertices, new_vertices])

    faces, sign, middle = mesh.faces[crossed], sign[crossed], new_index[edges.of_face[crossed]]
    # turn faces: one kept corner comes first; of two kept corners the one removed comes first; (-, 0, +) starts at -
    n_kept = (sign < 0).sum(axis=1)
    turn = np.where(n_kept == 2, np.argmax(sign > 0, axis=1), np.argmax(sign < 0, axis=1))
    index = (np.arange(3)[None, :] + turn[:, None]) % 3
    faces, sign, middle = (np.take_along_axis(x, index, axis=1) for x in (faces, sign, middle))
    one = (n_kept == 1) & (sign[:, 1] > 0) & (sign[:, 2] > 0)
    left, right = (n_kept == 1) & (sign[:, 1] == 0), (n_kept == 1) & (sign[:, 2] == 0)
    two = n_kept == 2
    pieces = [
        mesh.faces[whole],
        np.column_stack([faces[one, 0], middle[one, 0], middle[one, 2]]),
        np.column_stack([faces[left, 0], faces[left, 1], middle[left, 2]]),
        np.column_stack([faces[right, 0], middle[right, 0], faces[right, 2]]),
    ]
    m, b, c, n = middle[two, 0], faces[two, 1], faces[two, 2], middle[two, 2]
    shorter = np.linalg.norm(vertices[m] - vertices[c], axis=1) <= np.linalg.norm(vertices[b] - vertices[n], axis=1)
    pieces += [
        np.where(shorter[:, None], np.column_stack([m, b, c]), np.column_stack([m, b, n])),
        np.where(shorter[:, None], np.column_stack([m, c, n]), np.column_stack([b, c, n])),
    ]
    kept = np.vstack(pieces)
    if len(kept) == 0:
        raise GeometryError("the plane leaves nothing of the mesh", "move the plane")
    return compact(TriMesh(vertices, kept))


def _only_around(mesh: TriMesh, height: Floats, around: Ints) -> Floats:
    """Put everything behind the plane that is not joined to the vertices ``around`` in front of it."""
    graph = adjacency(mesh)
    front = np.flatnonzero(height > 0)
    _, label = csgraph.connected_components(graph[front][:, front], directed=False)
    removed = np.zeros(mesh.n_vertices, dtype=bool)
    removed[front] = np.isin(label, label[np.isin(front, around)])
    beside = (graph @ removed > 0) & (height == 0.0)
    return np.where(removed | beside, height, np.minimum(height, -1.0))


def trim(mesh: TriMesh, point: Floats, normal: Floats, *, snap: float = 0.1) -> TriMesh:
    """Cut a surface with a plane so that a disk is left: the largest piece behind it, with one clean boundary loop.

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold of genus 0; openings are allowed in the part that is removed.
    point, normal, snap
        See :func:`cut_by_plane`.

    Returns
    -------
    TriMesh
        Euler characteristic 1, one loop, which lies in the plane.

    Raises
    ------
    GeometryError
        If the plane misses the mesh.
    TopologyError
        If the scan ends before the plane, or the plane cuts the piece in several curves.
    """
    direction = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    height = (mesh.vertices - point) @ direction
    original = boundary_loops(mesh.faces)
    for loop in original:
        if height[loop].min() < 0:
            below = -float(height[loop].min())
            raise TopologyError(
                f"the scan ends {below:.1f} mm below the trimming plane (an opening of {loop_length(mesh, loop):.1f} mm length)",
                f"lower the plane by {below + 1:.0f} mm or more, or fill the opening if it is a hole",
            )
    pieces, _ = separate_fans(cut_by_plane(mesh, point, direction, snap))
    label = face_components(pieces.faces)
    area = np.bincount(label, weights=face_areas(pieces))
    kept = compact(pieces, label == int(np.argmax(area)))
    loops = boundary_loops(kept.faces)
    if len(loops) != 1:
        lengths = ", ".join(f"{loop_length(kept, loop):.1f}" for loop in loops[:6])
        raise TopologyError(
            f"the plane cuts the surface in {len(loops)} curves of {lengths} mm length, one is needed",
            "move the plane to where the bone is a single shaft",
        )
    chi = euler_characteristic(kept.faces)
    if chi != 1:
        raise TopologyError(
            f"the trimmed part is not a disk: its Euler characteristic is {chi}, must be 1", "run repair first"
        )
    return kept


def height_by_width(
    vertices: Floats, up: Floats, across: Floats, fraction: float, n_iterations: int = 100
) -> tuple[float, float]:
    """Find the height of a cut that lies ``fraction`` widths above the lowest point, of the part below the cut itself.

    The width is the extent along ``across`` of what lies below the cut: what comes above it (the head of a femur) does
    not count, so that a whole bone and its lower end give the same answer. The cut rises from near the lowest point until
    it is high enough for the width below it.

    Parameters
    ----------
    vertices : (n, 3) float64
    up, across : (3,) float64
        Unit vectors.
    fraction : float

    Returns
    -------
    height, width : float
        Height of the cut along ``up`` (absolute), and the width [mm].

    Examples
    --------
    >>> corners = np.array([[x, 0.0, z] for x in (0, 2) for z in np.linspace(0, 9, 10)])
    >>> height_by_width(corners, np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), 1.5)
    (3.0, 2.0)
    """
    along, sideways = vertices @ up, vertices @ across
    lowest = float(along.min())
    width = 0.02 * float(np.ptp(along)) / fraction
    for _ in range(n_iterations):
        wider = float(np.ptp(sideways[along <= lowest + fraction * width]))
        if wider <= width:
            break
        width = wider
    return lowest + fraction * width, width
