"""From a triangle soup to one oriented manifold surface, with a record of what was changed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import igl
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import face_areas, volume
from ssmpipe.core.mesh.topology import (
    Edges,
    boundary_loops,
    compact,
    face_components,
    handle_loop,
    loop_length,
    unique_edges,
)
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.flat_faces import remove_flat_faces


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A repaired mesh and what was done to it.

    Attributes
    ----------
    mesh : TriMesh
        Edge- and vertex-manifold, oriented, one component.
    changes : dict of str to int
        Counts: merged_vertices, degenerate_faces, duplicate_faces, fin_faces, flipped_faces, split_vertices,
        dropped_components, dropped_faces, unused_vertices; flat_faces (removed) and flat_faces_left.
    dropped_area_fraction : float
        Share of the area that was dropped as debris.
    """

    mesh: TriMesh
    changes: dict[str, int] = field(default_factory=dict)
    dropped_area_fraction: float = 0.0


def clean(
    mesh: TriMesh,
    *,
    debris_fraction: float = 0.02,
    components: Literal["one", "largest"] = "one",
    merge_tolerance: float = 1e-7,
) -> Cleaned:
    """Make one oriented manifold surface of a raw scan.

    In this order: merge vertices that coincide; drop faces that repeat a vertex; drop duplicate faces; drop fins (faces
    with an open side on an edge of more than two faces); orient faces alike; part what only touches along edges or in
    vertices; drop small components; remove faces without area (see :mod:`ssmpipe.core.repair.flat_faces`); turn the surface
    outward.

    Parameters
    ----------
    mesh : TriMesh
    debris_fraction : float
        A component with less than this share of the total area is debris [-].
    components : {"one", "largest"}
        What to do when more than one component is larger than debris: refuse, or keep the one with the largest area.
    merge_tolerance : float
        Vertices nearer than this share of the bounding box's diagonal are one [-].

    Raises
    ------
    TopologyError
        If several large components are left, the surface falls into crumbs, or it cannot be oriented.
    """
    changes: dict[str, int] = {}
    vertices, faces = mesh.vertices, mesh.faces
    used = np.flatnonzero(np.bincount(faces.ravel()))
    changes["unused_vertices"] = len(vertices) - len(used)

    representative = coincident_vertices(
        vertices, merge_tolerance * float(np.linalg.norm(np.ptp(vertices[used], axis=0))), used
    )
    merged = representative[faces]
    changes["merged_vertices"] = len(used) - int(np.count_nonzero(np.bincount(merged.ravel())))
    faces = merged

    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    changes["degenerate_faces"] = int(degenerate.sum())
    faces = faces[~degenerate]
    if len(faces) == 0:
        raise TopologyError("every face is degenerate (repeats a vertex)", "check the units and the export of the scan")

    ordered = np.sort(faces, axis=1)
    order = np.lexsort(ordered.T)
    first = order[np.r_[True, (ordered[order[1:]] != ordered[order[:-1]]).any(axis=1)]]
    changes["duplicate_faces"] = len(faces) - len(first)
    faces = faces[np.sort(first)]

    faces, changes["fin_faces"] = drop_fins(faces)
    faces, changes["flipped_faces"] = orient_alike(faces, vertices)
    split, changes["split_vertices"] = separate_fans(TriMesh(vertices, faces))

    label = face_components(split.faces)
    area = np.bincount(label, weights=face_areas(split))
    share = area / area.sum() if area.sum() > 0 else np.full(len(area), 1.0 / len(area))
    large = np.flatnonzero(share >= debris_fraction)
    if len(large) == 0 and len(area) > 50:
        raise TopologyError(
            f"the surface falls into {len(area)} pieces, the largest with {100 * share.max():.2g} % of the area: its faces do not share "
            "vertices",
            "merge vertices that lie farther apart with repair.merge_tolerance (1e-5), or export the scan with shared vertices",
        )
    if len(large) == 0:
        large = np.array([int(np.argmax(share))])
    if len(large) > 1 and components == "one":
        raise TopologyError(
            _describe_components(split, label, share, large),
            "remove the others in the segmentation, or keep the largest with repair.components: largest",
        )
    keep = int(large[np.argmax(share[large])])
    changes["dropped_components"] = len(area) - 1
    changes["dropped_faces"] = int((label != keep).sum())
    kept, n_flat, n_left = remove_flat_faces(compact(split, label == keep))
    changes["flat_faces"], changes["flat_faces_left"] = n_flat - n_left, n_left
    if not points_outward(kept):
        kept = TriMesh(kept.vertices, kept.faces[:, ::-1])
        changes["flipped_faces"] = len(kept.faces) - changes["flipped_faces"]
    return Cleaned(kept, changes, float(1.0 - share[keep]))


def coincident_vertices(vertices: Floats, tolerance: float, used: Ints | None = None) -> Ints:
    """Return for every vertex the index of the first vertex that it coincides with, (n_vertices,).

    Examples
    --------
    >>> coincident_vertices(np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1e-9]]), 1e-6)
    array([0, 1, 0])
    """
    used = np.arange(len(vertices)) if used is None else used
    points = vertices[used]
    # equal coordinates first, by sorting: a tree over the threefold points of an STL soup would be slow
    order = np.lexsort(points.T)
    new = np.r_[True, (points[order[1:]] != points[order[:-1]]).any(axis=1)]
    distinct = order[new]
    group = np.empty(len(points), dtype=np.int64)
    group[order] = np.cumsum(new) - 1
    pairs = cKDTree(points[distinct]).query_pairs(tolerance, output_type="ndarray")
    n = len(distinct)
    graph = sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = csgraph.connected_components(graph, directed=False)[1][group]
    _, first = np.unique(label, return_index=True)
    result = np.arange(len(vertices))
    result[used] = used[first[label]]
    return result


def drop_fins(faces: Ints) -> tuple[Ints, int]:
    """Drop faces that have an open side and another side on an edge of more than two faces, until there are none."""
    before = len(faces)
    while True:
        edges = unique_edges(faces)
        count = edges.n_faces[edges.of_face]
        fin = (count == 1).any(axis=1) & (count > 2).any(axis=1)
        if not fin.any() or fin.all():
            return faces, before - len(faces)
        faces = faces[~fin]


def orient_alike(faces: Ints, vertices: Floats) -> tuple[Ints, int]:
    """Turn faces so that neighbours run along their common edge in opposite directions.

    In each patch the direction of the majority stays.

    Returns
    -------
    faces : (n_faces, 3)
    n_flipped : int

    Raises
    ------
    TopologyError
        If the surface is one-sided.
    """
    oriented, patch = igl.bfs_orient(np.ascontiguousarray(faces))
    # libigl may return the corners in any rotation: compare the cyclic direction only
    flipped = ~_same_direction(faces, oriented)
    patch = np.asarray(patch).ravel()
    n_patches = int(patch.max()) + 1
    most = np.bincount(patch, weights=flipped, minlength=n_patches) > 0.5 * np.bincount(patch, minlength=n_patches)
    flipped ^= most[patch]
    result = np.where(flipped[:, None], faces[:, ::-1], faces)
    edges = unique_edges(result)
    inner = edges.n_faces == 2
    forward = np.bincount(edges.of_face.ravel(), weights=edges.forward.ravel(), minlength=len(inner))
    bad = np.flatnonzero(inner & (forward != 1))
    if len(bad):
        x, y, z = vertices[edges.vertices[bad]].mean(axis=(0, 1))
        raise TopologyError(
            f"the surface is one-sided (a Moebius band): {len(bad)} edges near ({x:.1f}, {y:.1f}, {z:.1f}) mm cannot be oriented",
            "repair the segmentation there",
        )
    return result, int(flipped.sum())


def _same_direction(a: Ints, b: Ints) -> Bools:
    turned = np.stack([np.roll(b, k, axis=1) for k in range(3)], axis=1)
    return np.asarray((turned == a[:, None, :]).all(axis=2).any(axis=1))


def separate_fans(mesh: TriMesh) -> tuple[TriMesh, int]:
    """Give every fan of faces its own vertex, so that sheets which only touch come apart.

    Faces are joined across edges of two faces. At an edge of four or more faces, each face is joined to the neighbour
    that bounds the same solid wedge (next in angle, opposite direction), when directions allow it; otherwise the edge
    is opened.

    Returns
    -------
    mesh : TriMesh
        Vertex-manifold; edge-manifold.
    n_split : int
        Number of vertices added.
    """
    faces = mesh.faces
    edges = unique_edges(faces)
    order = np.argsort(edges.of_face.ravel(), kind="stable")
    start = np.concatenate([[0], np.cumsum(edges.n_faces)])
    inner = np.flatnonzero(edges.n_faces == 2)
    pairs = [np.column_stack([order[start[inner]], order[start[inner] + 1]])]
    pairs += [
        _pair_by_angle(mesh, edges, int(e), order[start[e] : start[e + 1]]) for e in np.flatnonzero(edges.n_faces > 2)
    ]
    half_a, half_b = np.vstack(pairs).T
    # half-edge 3 f + k runs from corner k to corner k + 1 of face f
    tail = lambda h: h  # noqa: E731
    head = lambda h: h - h % 3 + (h + 1) % 3  # noqa: E731
    corner = faces.ravel()
    aligned = corner[tail(half_a)] == corner[tail(half_b)]
    partner_tail = np.where(aligned, tail(half_b), head(half_b))
    partner_head = np.where(aligned, head(half_b), tail(half_b))
    rows, columns = np.r_[tail(half_a), head(half_a)], np.r_[partner_tail, partner_head]
    n = 3 * len(faces)
    graph = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    label = csgraph.connected_components(graph, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    owner = corner[first]  # old vertex of each fan
    by_owner = np.lexsort((first, owner))
    is_first = np.r_[True, owner[by_owner][1:] != owner[by_owner][:-1]]
    number = np.empty(len(first), dtype=np.int64)
    number[by_owner[is_first]] = owner[by_owner[is_first]]
    extra = by_owner[~is_first]
    number[extra] = mesh.n_vertices + np.arange(len(extra))
    vertices = np.vstack([mesh.vertices, mesh.vertices[owner[extra]]])
    return TriMesh(vertices, number[label].reshape(-1, 3)), len(extra)


def _pair_by_angle(mesh: TriMesh, edges: Edges, edge: int, half: Ints) -> Ints:
    """Pair the half-edges at an edge of many faces around the solid wedges between them; (n, 2), maybe empty."""
    a, b = mesh.vertices[edges.vertices[edge]]
    opposite = mesh.vertices[mesh.faces[half // 3, (half + 2) % 3]] - a
    axis = (b - a) / max(float(np.linalg.norm(b - a)), np.finfo(float).tiny)
    away = opposite - np.outer(opposite @ axis, axis)
    angle = np.arctan2(np.cross(away[0], away) @ axis, away @ away[0])
    turn = np.argsort(angle, kind="stable")
    half, forward = half[turn], edges.forward.ravel()[half[turn]]
    if forward.sum() * 2 != len(half) or (forward == np.roll(forward, 1)).any():
        return np.empty((0, 2), dtype=np.int64)
    # outside of a face that runs along the axis lies on the side of smaller angle: its solid wedge follows it
    at = np.flatnonzero(~forward)
    return np.column_stack([half[at], half[(at + 1) % len(half)]])


def points_outward(mesh: TriMesh) -> bool:
    """Say whether the normals of an oriented mesh point out of the body.

    Openings are closed in thought by cones to the middle of each loop. A surface that is nearly flat has no inside;
    its own direction counts as outward.
    """
    enclosed = volume(close_openings(mesh))
    scale = float(face_areas(mesh).sum()) ** 1.5
    return enclosed > -1e-3 * scale if scale > 0 else True


def _describe_components(mesh: TriMesh, label: Ints, share: Floats, large: Ints) -> str:
    large = large[np.argsort(-share[large], kind="stable")]
    shares = ", ".join(f"{100 * s:.1f} %" for s in share[large][:6]) + (", ..." if len(large) > 6 else "")
    text = f"the mesh has {len(large)} components of {shares} of the area"
    outer = compact(mesh, label == large[0])
    inside = 0
    for k in large[1:]:
        point = mesh.vertices[mesh.faces[label == k][0]].mean(axis=0)
        inside += abs(float(np.ravel(igl.winding_number(outer.vertices, outer.faces, point[None, :]))[0])) > 0.5
    if inside:
        text += f" ({inside} of them inside the largest, such as the wall of a medullary cavity)"
    return text


def check_handles(mesh: TriMesh) -> None:
    """Refuse a surface with handles.

    Raises
    ------
    TopologyError
        Names their number and the middle and length of a short loop around or through one.
    """
    loops = boundary_loops(mesh.faces)
    chi = mesh.n_vertices - len(unique_edges(mesh.faces).vertices) + mesh.n_faces
    n_handles = (2 - len(loops) - chi) // 2
    if n_handles == 0:
        return
    closed = close_openings(mesh)
    loop = handle_loop(closed)
    where = ""
    if loop is not None:
        x, y, z = closed.vertices[loop].mean(axis=0)
        length = loop_length(closed, loop)
        where = f"; a loop of {length:.1f} mm around one lies at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    raise TopologyError(
        f"the surface has {n_handles} handle{'s' if n_handles > 1 else ''} (genus {n_handles}), it must have none{where}",
        "close the hole or cut the bridge in the segmentation, or allow it with repair.max_handle_mm; anatomy with a true hole "
        "(a vertebra) is beyond this method",
    )


def check_openings(mesh: TriMesh, max_openings: int) -> None:
    """Refuse a surface with more openings than allowed.

    Raises
    ------
    TopologyError
        Names the number and the lengths of the boundary loops.
    """
    loops = boundary_loops(mesh.faces)
    if len(loops) <= max_openings:
        return
    lengths = sorted((loop_length(mesh, loop) for loop in loops), reverse=True)
    text = ", ".join(f"{x:.1f}" for x in lengths[:6]) + (", ..." if len(lengths) > 6 else "")
    expected = "a closed surface is expected" if max_openings == 0 else f"at most {max_openings} expected"
    raise TopologyError(
        f"the surface has {len(loops)} opening{'s' if len(loops) > 1 else ''} of {text} mm length; {expected}",
        "close them in the segmentation, or allow them with repair.max_openings",
    )


def close_openings(mesh: TriMesh) -> TriMesh:
    """Close every boundary loop with a fan around its middle (for counting and measuring, not for modelling)."""
    vertices, faces = [mesh.vertices], [mesh.faces]
    for number, loop in enumerate(boundary_loops(mesh.faces)):
        vertices.append(mesh.vertices[loop].mean(axis=0, keepdims=True))
        apex = np.full(len(loop), mesh.n_vertices + number)
        faces.append(np.column_stack([np.roll(loop, -1), loop, apex]))
    return TriMesh(np.vstack(vertices), np.vstack(faces))
