"""Map a tube that was cut open to the square, with period 1 in u and little stretch."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import FoldoverError, TopologyError
from ssmpipe.core.mesh.operators import face_areas
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import square_boundary
from ssmpipe.core.parameterize.distortion import folded
from ssmpipe.core.parameterize.periodic import periodic_stretch, squared_derivatives
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.core.parameterize.weights import Weighting, neighbour_weights
from ssmpipe.core.result import Result, Status

SeamSides = Literal["periodic", "straight"]


def parameterize_tube(
    mesh: TriMesh,
    seam: Seam,
    *,
    sides: SeamSides = "periodic",
    weighting: Weighting = "mean-value",
    eta: float = 0.5,
    max_iterations: int = 50,
) -> Result[Floats]:
    """Map a tube one-to-one to the square, period 1 in u, and relax its stretch (Li 2015, sections 4.2 and 4.5).

    Each rim goes to an edge v = 0 or v = 1 by arc length from the seam on. Each other vertex is a weighted average of its neighbours,
    and the weights of the neighbours are divided by a power of their stretch, round by round, as for the square
    (:func:`~ssmpipe.core.parameterize.stretch.parameterize_square`). The stretch is that at the best ratio of the units of u and v,
    1 for a cylinder.

    Parameters
    ----------
    mesh : TriMesh
        Cut open along ``seam``; without inner edges that join two vertices of a rim.
    seam : Seam
    sides : {"periodic", "straight"}
        ``periodic``: the seam lies where its neighbours on both sides put it. ``straight``: the thesis's way, the seam is the line
        u = 0 by arc length; then no inner edge may join two of its vertices either.
    weighting, eta, max_iterations
        As for the square.

    Returns
    -------
    Result of (n_vertices, 2) float64
        Both vertices of a pair have the same v to the bit, and u of the right one is that of the left one plus 1.
        ``history["stretch"]`` starts with the first map.

    Raises
    ------
    TopologyError
        If the seam does not run from rim to rim.
    FoldoverError
        If a triangle is turned over; says how many and where.
    """
    origin, whole = _rejoined(mesh, seam)
    fixed, fixed_uv = _rims(mesh, seam)
    if sides == "straight":
        rim, rim_uv = _square_rim(mesh, seam)
        place = {int(v): k for k, v in enumerate(rim)}
        side = seam.pairs[1:-1, 0]
        at = np.array([place[int(v)] for v in side], dtype=np.int64)
        fixed, fixed_uv = np.concatenate([fixed, side]), np.concatenate([fixed_uv, rim_uv[at] * [0.0, 1.0]])
    weights = neighbour_weights(whole, weighting)
    jumps = _jumps(mesh, seam, origin)
    uv = _solve(weights, jumps, origin, seam, fixed, fixed_uv)
    _refuse_folds(mesh, uv, weighting)
    history = [periodic_stretch(mesh, uv, ())]
    areas = face_areas(mesh)
    corners = origin[mesh.faces].ravel()
    total = np.bincount(corners, np.repeat(areas, 3))
    status: Status = "out-of-iterations"
    for _ in range(max_iterations):
        square_u, square_v = squared_derivatives(mesh, uv, ())
        ratio = np.sqrt((areas @ square_v) / (areas @ square_u))
        energy = areas * (ratio * square_u + square_v / ratio)
        sigma = np.sqrt(np.bincount(corners, np.repeat(energy, 3)) / total)
        weights = sparse.csr_matrix(weights @ sparse.diags((sigma / sigma.mean()) ** -eta))
        candidate = _solve(weights, jumps, origin, seam, fixed, fixed_uv)
        stretch = periodic_stretch(mesh, candidate, ())
        if not stretch < history[-1] or folded(candidate, mesh.faces).any():
            status = "converged"
            break
        uv = candidate
        history.append(stretch)
    return Result(uv, status, len(history) - 1, len(history), {"stretch": np.array(history)})


def _rejoined(mesh: TriMesh, seam: Seam) -> tuple[Ints, TriMesh]:
    """Return the vertex of the uncut mesh of each vertex of the cut one, and the uncut mesh."""
    label = np.arange(mesh.n_vertices)
    label[seam.pairs[:, 1]] = seam.pairs[:, 0]
    kept, origin = np.unique(label, return_inverse=True)
    origin = origin.ravel().astype(np.int64)
    return origin, TriMesh(mesh.vertices[kept], origin[mesh.faces])


def _square_rim(mesh: TriMesh, seam: Seam) -> tuple[Ints, Floats]:
    """Return the boundary of the cut mesh laid around the square by arc length, the ends of the seam at the corners."""
    (a, b), (d, c) = seam.pairs[0], seam.pairs[-1]
    loops = boundary_loops(mesh.faces)
    if len(loops) != 1 or not np.isin(seam.pairs, loops[0]).all():
        raise TopologyError(
            "the surface and its seam do not belong together: it was not cut along the seam",
            "run cut again, just before parameterize",
        )
    place = {int(v): k for k, v in enumerate(loops[0])}
    along = [(place[int(corner)] - place[int(a)]) % len(loops[0]) for corner in (a, b, c, d)]
    if along != sorted(along):
        raise TopologyError(
            "the seam runs from right to left, or from opening 2 to opening 1",
            "run cut again, just before parameterize",
        )
    return square_boundary(mesh, np.array([a, b, c, d]))


def _rims(mesh: TriMesh, seam: Seam) -> tuple[Ints, Floats]:
    """Return the vertices of both rims, right copies left out, and their places."""
    rim, uv = _square_rim(mesh, seam)
    ends = np.isin(rim, seam.pairs[[0, -1]])
    inside = ~np.isin(rim, seam.pairs) & ((uv[:, 1] == 0.0) | (uv[:, 1] == 1.0))
    chosen = inside | (ends & ~np.isin(rim, seam.pairs[:, 1]))
    return rim[chosen], uv[chosen]


def _jumps(mesh: TriMesh, seam: Seam, origin: Ints) -> sparse.csr_matrix:
    """Return by how much u of a neighbour has to be raised, seen from each vertex of the uncut mesh: -1, 0 or 1."""
    raised = np.zeros(mesh.n_vertices)
    raised[seam.pairs[:, 1]] = 1.0
    half = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2).reshape(-1, 2)
    both = np.concatenate([half, half[:, ::-1]])
    jump = raised[both[:, 1]] - raised[both[:, 0]]
    n = int(origin.max()) + 1
    keys, first = np.unique(origin[both[:, 0]] * n + origin[both[:, 1]], return_index=True)
    return sparse.csr_matrix((jump[first], (keys // n, keys % n)), shape=(n, n))


def _solve(
    weights: sparse.csr_matrix, jumps: sparse.csr_matrix, origin: Ints, seam: Seam, fixed: Ints, fixed_uv: Floats
) -> Floats:
    """Return the map of the cut mesh in which every vertex that is not fixed is the weighted average of its neighbours."""
    n = weights.shape[0]
    rows = sparse.diags(1.0 / np.asarray(weights.sum(axis=1)).ravel()) @ weights
    values = np.zeros((n, 2))
    values[origin[fixed]] = fixed_uv
    free = np.ones(n, dtype=bool)
    free[origin[fixed]] = False
    inner = np.flatnonzero(free)
    flow = np.column_stack([np.asarray(rows.multiply(jumps).sum(axis=1)).ravel(), np.zeros(n)])
    right = (rows @ values + flow)[inner]
    matrix = sparse.identity(len(inner), format="csc") - sparse.csc_matrix(rows[inner][:, inner])
    values[inner] = splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
    ).solve(right)
    uv = values[origin]
    uv[seam.pairs[:, 1], 0] += 1.0
    return uv


def _refuse_folds(mesh: TriMesh, uv: Floats, weighting: Weighting) -> None:
    bad = np.flatnonzero(folded(uv, mesh.faces))
    if len(bad) == 0:
        return
    x, y, z = mesh.vertices[mesh.faces[bad[0]]].mean(axis=0)
    remedy = (
        "smooth or decimate the mesh first, it has slivers"
        if weighting == "mean-value"
        else "use weighting: mean-value"
    )
    raise FoldoverError(
        f"{len(bad)} of {mesh.n_faces} triangles are turned over in the square, the first at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
        remedy,
    )
