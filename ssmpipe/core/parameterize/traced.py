"""Map a cap to the square between two traced gradient lines, for comparison with the periodic solve."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.topology import unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import rim_of, split_chords
from ssmpipe.core.parameterize.cone import FLOOR, Y_AXIS, PoleMap, finished, refuse_folds
from ssmpipe.core.parameterize.cutting import Opened, cut_along
from ssmpipe.core.parameterize.generatrix import insert_on_rim, rim_place
from ssmpipe.core.parameterize.geodesic import inserted
from ssmpipe.core.parameterize.gradient_line import gradient_line
from ssmpipe.core.parameterize.harmonic import solve_averages
from ssmpipe.core.parameterize.periodic import folded_periodic, periodic_stretch
from ssmpipe.core.parameterize.poles import insert_point
from ssmpipe.core.parameterize.weights import neighbour_weights

REMEDY = "use cone: periodic, or smooth or decimate the mesh first"


@dataclass(frozen=True, eq=False)
class Traced:
    """A cap with two gradient lines in it.

    Attributes
    ----------
    mesh : TriMesh
        Both lines are edges.
    v : (n_vertices,) float64
        0 at the rim, 1 at the apex.
    seam, opposite : (n,) int64
        Vertices of the lines, from the rim to the apex.
    """

    mesh: TriMesh
    v: Floats
    seam: Ints
    opposite: Ints


def parameterize_traced(
    mesh: TriMesh,
    apex: Floats,
    *,
    seam_point: Floats | None = None,
    seam_direction: Floats | None = None,
    n_remap: int = 10,
) -> PoleMap:
    """Map a cap one-to-one to the square [0, 1)^2 between two traced gradient lines (Li 2015, section 5.2.4).

    1. v is harmonic, 0 at the rim and 1 at the apex.
    2. Two lines of steepest ascent of v are traced to the apex and become edges: the generatrix from the seam's place on the rim, the
       opposite one from half way around the rim.
    3. u is harmonic in each of the two regions between them, from 0 to 0.5 with u free at the rim; the second region is mirrored, so that
       u runs on to 1. Its slope jumps at the opposite line by the ratio of the regions' widths (``kink``).
    4. Where negative cotangent weights turn a triangle over, u is solved again with small positive ones in their place.
    5. u and v are changed by one function each (:func:`~ssmpipe.core.parameterize.remap.remap_periodic`).

    The stretch is not relaxed in between: rounds of :func:`~ssmpipe.core.parameterize.periodic.relax` know of no lines.

    Parameters
    ----------
    mesh : TriMesh
        With one boundary loop.
    apex : (3,) float64
        The nearest place of the surface becomes a vertex [mm].
    seam_point : (3,) float64, optional
        The generatrix starts where the line of steepest descent from the nearest vertex meets the rim [mm].
    seam_direction : (3,) float64, optional
        Without a point it starts on this side of the rim's centroid; y by default.
    n_remap : int
        Coefficients of the changes of u and of v; 0 makes none.

    Returns
    -------
    PoleMap

    Raises
    ------
    TopologyError
        If the surface has another number of boundary loops.
    GeometryError
        If a line does not reach the apex, or the lines meet before it.
    FoldoverError
        If a triangle is turned over; says how many and where.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> from ssmpipe.core.repair.trimming import trim
    >>> dome = trim(sphere(10.0), np.zeros(3), np.array([0, 0, -1.0]))
    >>> found = parameterize_traced(dome, np.array([0, 0, 10.0]), n_remap=0)
    >>> x, y, z = found.mesh.vertices.T
    >>> found.uv[(x < -9) & (abs(y) < 1e-9), 0].round(2)  # a quarter of the way from y, counter-clockwise from above
    array([0.25, 0.25, 0.25, 0.25])
    """
    rim_of(mesh)
    mesh, top = insert_point(split_chords(mesh), apex)
    direction = Y_AXIS if seam_direction is None else seam_direction
    n_folds = 0
    traced = _traced(mesh, top, seam_point, direction)
    opened = cut_along(traced.mesh, traced.seam, (top,))
    for positive in (False, True):
        uv = _between(opened, traced, positive)
        folds = int(folded_periodic(opened.mesh, uv, (top,)).sum())
        if not folds:
            break
        n_folds = n_folds or folds
    refuse_folds(opened.mesh, uv, (top,), REMEDY)
    stretch = np.array([periodic_stretch(opened.mesh, uv, (top,))])

    def placed(uv: Floats) -> Floats:
        return uv - [uv[opened.pairs[0, 0], 0], 0.0]

    found = finished(opened, (top,), uv, uv, stretch, placed, n_remap, REMEDY)
    return replace(found, n_folds_harmonic=n_folds, kink=_kink(opened.mesh, uv, top))


def _traced(mesh: TriMesh, top: int, seam_point: Floats | None, direction: Floats) -> Traced:
    if seam_point is None:
        place = rim_place(mesh, rim_of(mesh), direction)[0]
    else:
        place = _down_from(mesh, _height(mesh, top), seam_point)
    mesh, start = insert_on_rim(mesh, rim_of(mesh), place)
    mesh, opposite = insert_on_rim(mesh, rim_of(mesh), _half_way(mesh, rim_of(mesh), start))
    v = _height(mesh, top)
    lines: list[Ints] = []
    for begin in (start, opposite):
        line = gradient_line(mesh, v, begin)
        end = int(line.edges[-1, 0])
        if end != top:
            raise _failed(mesh, end, "a gradient line ends before the apex")
        if lines:
            meets = np.isin(line.edges[:-1], lines[0]).all(axis=1)
            if meets.any():
                raise _failed(mesh, int(line.edges[meets.argmax(), 0]), "the two gradient lines meet before the apex")
        crossing = line.edges[:, 0] != line.edges[:, 1]
        at = v[line.edges[:, 0]] + line.fraction * (v[line.edges[:, 1]] - v[line.edges[:, 0]])
        mesh, path = inserted(mesh, line, snap=0.0)
        v = np.concatenate([v, at[crossing]])
        lines.append(_without_detours(mesh, path))
    return Traced(mesh, v, lines[0], lines[1])


def _without_detours(mesh: TriMesh, path: Ints) -> Ints:
    """Leave out what lies between two vertices of a path that an edge joins.

    A face with three corners on a line would have no area in the square.
    """
    edges = unique_edges(mesh.faces).vertices
    known = {(int(a), int(b)) for a, b in edges[np.isin(edges, path).all(axis=1)]}
    kept = [int(path[0])]
    k = 0
    while k < len(path) - 1:
        last = [m for m in range(k + 1, len(path)) if tuple(sorted((kept[-1], int(path[m])))) in known]
        k = last[-1]
        kept.append(int(path[k]))
    return np.array(kept)


def _height(mesh: TriMesh, top: int) -> Floats:
    """Return the harmonic function that is 0 at the rim and 1 at the apex, (n_vertices,)."""
    rim = rim_of(mesh)
    return solve_averages(
        _weights(mesh, positive=False), np.append(rim, top), np.append(np.zeros(len(rim)), 1.0)[:, None]
    )[:, 0]


def _between(opened: Opened, traced: Traced, positive: bool) -> Floats:
    """Return the map of the cut mesh, (n_vertices, 2).

    The values on both lines are given, so that the regions know nothing of each other and one solve serves them both.
    """
    mesh, (left, right), top = opened.mesh, opened.pairs.T, int(traced.seam[-1])
    middle = traced.opposite[:-1]
    # the pole pulls a neighbour straight up, it has no part in the equations of u
    others = sparse.diags((np.arange(mesh.n_vertices) != top).astype(np.float64))
    weights = sparse.csr_matrix(others @ _weights(mesh, positive) @ others)
    fixed = np.concatenate([left, right, middle, [top]])
    given = np.repeat([0.0, 1.0, 0.5, 0.5], [len(left), len(right), len(middle), 1])
    u = solve_averages(weights, fixed, given[:, None])[:, 0]
    beside = np.setdiff1d(mesh.faces[(mesh.faces == top).any(axis=1)], [top])
    u[top] = u[beside].mean()
    return np.column_stack([u, traced.v[opened.origin]])


def _weights(mesh: TriMesh, positive: bool) -> sparse.csr_matrix:
    """Return cotangent weights; negative ones raised to a small share of the mean one if asked."""
    weights = neighbour_weights(mesh, "harmonic")
    if positive:
        weights.data = np.maximum(weights.data, FLOOR * float(np.abs(weights.data).mean()))
    return weights


def _down_from(mesh: TriMesh, v: Floats, point: Floats) -> Floats:
    """Return where the line of steepest descent from the vertex nearest to a point meets the rim, (3,) [mm]."""
    begin = int(np.argmin(np.linalg.norm(mesh.vertices - point, axis=1)))
    line = gradient_line(mesh, -v, begin)
    (a, b), t = line.edges[-1], line.fraction[-1]
    if v[a] > 0 or v[b] > 0:
        raise _failed(mesh, int(a), "the line from the landmark of the role seam does not reach the rim")
    return np.asarray((1 - t) * mesh.vertices[a] + t * mesh.vertices[b])


def _half_way(mesh: TriMesh, rim: Ints, start: int) -> Floats:
    """Return the place half way around a rim from one of its vertices, by arc length, (3,) [mm]."""
    loop = np.roll(rim, -int(np.flatnonzero(rim == start)[0]))
    loop = np.append(loop, start)
    along = np.append(0.0, np.cumsum(edge_lengths(mesh, np.column_stack([loop[:-1], loop[1:]]))))
    return np.array([np.interp(0.5 * along[-1], along, mesh.vertices[loop, k]) for k in range(3)])


def _kink(mesh: TriMesh, uv: Floats, top: int) -> float:
    """Return the mean slope of u behind the opposite line by that before it.

    The flow of a harmonic function through a region is its Dirichlet energy divided by the difference of its values.
    """
    weights = sparse.coo_matrix(neighbour_weights(mesh, "harmonic"))
    i, j = weights.row, weights.col
    energy = np.where((i == top) | (j == top), 0.0, weights.data * (uv[i, 0] - uv[j, 0]) ** 2)
    behind = uv[i, 0] + uv[j, 0] > 1.0
    return float(energy[behind].sum() / energy[~behind].sum())


def _failed(mesh: TriMesh, vertex: int, fact: str) -> GeometryError:
    x, y, z = mesh.vertices[vertex]
    return GeometryError(f"{fact}, at ({x:.1f}, {y:.1f}, {z:.1f}) mm", REMEDY)
