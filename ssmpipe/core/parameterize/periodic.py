"""Maps with period 1 in u: harmonic from pole to rim or pole to pole, then relaxed in stretch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.mesh.operators import face_areas
from ssmpipe.core.mesh.symmetric import solve
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.cutting import Opened
from ssmpipe.core.parameterize.distortion import signed_uv_areas
from ssmpipe.core.parameterize.weights import neighbour_weights
from ssmpipe.core.result import Result, Status


@dataclass(frozen=True, eq=False)
class Wrapped:
    """A surface around which u runs once: what the periodic solves need to know of it.

    Attributes
    ----------
    opened : Opened
        Cut along the seam.
    bottom, top : (n,) int64
        Vertices with v = 0 and v = 1: a rim, or one pole.
    poles : tuple of int
        Those of them where u means nothing.
    edges : (n_edges, 2) int64
        Of the uncut mesh.
    jumps : (n_edges,) float64
        By how much u of the second end has to be raised, seen from the first one: -1, 0 or 1.
    """

    opened: Opened
    bottom: Ints
    top: Ints
    poles: tuple[int, ...]
    edges: Ints
    jumps: Floats


def wrap(opened: Opened, bottom: Ints, top: Ints, poles: tuple[int, ...]) -> Wrapped:
    """Collect the edges and the jumps of u over the seam."""
    origin = opened.origin
    raised = np.zeros(len(origin))
    raised[opened.pairs[:, 1]] = 1.0
    half = np.stack([opened.mesh.faces, np.roll(opened.mesh.faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ends = origin[half]
    forward = ends[:, 0] < ends[:, 1]
    n = int(origin.max()) + 1
    keys, first = np.unique(ends.min(axis=1) * n + ends.max(axis=1), return_index=True)
    jump = raised[half[:, 1]] - raised[half[:, 0]]
    return Wrapped(
        opened,
        bottom,
        top,
        poles,
        np.column_stack([keys // n, keys % n]),
        np.where(forward, jump, -jump)[first],
    )


def harmonic_weights(mesh: TriMesh, edges: Ints) -> Floats:
    """Return the cotangent weight of each edge, (n_edges,) (Pinkall and Polthier 1993); negative ones are possible."""
    matrix = neighbour_weights(mesh, "harmonic")
    return np.asarray(matrix[edges[:, 0], edges[:, 1]]).ravel()


def solve_periodic(wrapped: Wrapped, weights: Floats) -> Floats:
    """Return the map in which every vertex is the weighted average of its neighbours, (n_vertices_cut, 2).

    v is 0 on the bottom and 1 on the top. u is free there (its natural boundary condition), and gains 1 once around the surface.
    With positive weights no triangle is turned over: u and v are the two harmonic one-forms of a torus, the surface doubled at
    its rims (Gortler, Gotsman and Thurston 2006); a pole is a whole edge of the square, so that it pulls each neighbour straight up.
    """
    n = int(wrapped.opened.origin.max()) + 1
    i, j = wrapped.edges.T
    at = np.concatenate([i, j])
    laplacian = sparse.csc_matrix(
        (
            np.concatenate([np.tile(weights, 2), -weights, -weights]),
            (np.concatenate([at, i, j]), np.concatenate([at, j, i])),
        ),
        shape=(n, n),
    )
    v = np.zeros(n)
    v[wrapped.top] = 1.0
    fixed = np.concatenate([wrapped.bottom, wrapped.top])
    free = np.setdiff1d(np.arange(n), fixed)
    right = -np.asarray(laplacian[free][:, wrapped.top].sum(axis=1)).ravel()
    v[free] = solve(laplacian[free][:, free], right)
    # the pole pulls a neighbour straight up, it has no part in the equations of u
    beside = np.isin(wrapped.edges, wrapped.poles).any(axis=1)
    w = np.where(beside, 0.0, weights)
    laplacian_u = sparse.csc_matrix(
        (np.concatenate([np.tile(w, 2), -w, -w]), (np.concatenate([at, i, j]), np.concatenate([at, j, i]))),
        shape=(n, n),
    )
    flow = np.zeros(n)
    np.add.at(flow, i, w * wrapped.jumps)
    np.add.at(flow, j, -w * wrapped.jumps)
    inner = np.setdiff1d(np.arange(n), wrapped.poles)[1:]
    u = np.zeros(n)
    u[inner] = solve(laplacian_u[inner][:, inner], flow[inner])
    return onto_cut(wrapped, np.column_stack([u, v]))


def onto_cut(wrapped: Wrapped, uv: Floats) -> Floats:
    """Return the map of the cut mesh from that of the uncut one; a pole gets the mean u of its neighbours."""
    origin, pairs = wrapped.opened.origin, wrapped.opened.pairs
    out = uv[origin]
    out[pairs[:, 1], 0] += 1.0
    for pole in wrapped.poles:
        faces = wrapped.opened.mesh.faces
        at = faces[(faces == pole).any(axis=1)]
        out[pole, 0] = out[np.setdiff1d(at, [pole]), 0].mean()
    return out


def squared_derivatives(mesh: TriMesh, uv: Floats, poles: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Return the mean of |S_u|^2 and |S_v|^2 over each triangle, (n_faces,) each [mm^2]; infinite where one is turned over.

    A face at a pole is a ruled patch between the opposite edge and the pole.
    """
    p, (u, v) = mesh.vertices[mesh.faces], np.moveaxis(uv[mesh.faces], 2, 0)
    twice = 2.0 * signed_uv_areas(uv, mesh.faces)
    s_u = np.einsum("fkd,fk->fd", p, np.stack([v[:, 1] - v[:, 2], v[:, 2] - v[:, 0], v[:, 0] - v[:, 1]], axis=1))
    s_v = np.einsum("fkd,fk->fd", p, np.stack([u[:, 2] - u[:, 1], u[:, 0] - u[:, 2], u[:, 1] - u[:, 0]], axis=1))
    good = twice > 0
    square_u = np.divide((s_u**2).sum(axis=1), twice**2, out=np.full(len(p), np.inf), where=good)
    square_v = np.divide((s_v**2).sum(axis=1), twice**2, out=np.full(len(p), np.inf), where=good)
    faces, base, pole = pole_faces(mesh.faces, poles)
    du, dv = (uv[base[:, 1]] - uv[base[:, 0]]).T
    rise = uv[pole, 1] - uv[base, 1].mean(axis=1) if len(faces) else np.zeros(0)
    along = mesh.vertices[base[:, 1]] - mesh.vertices[base[:, 0]]
    to_pole = mesh.vertices[pole] - mesh.vertices[base].mean(axis=1)
    # at the share t of the way to the pole S_u is (1 - t) times its value at the edge, and so is the width of the patch
    good = (du * np.sign(rise) > 0) & (rise != 0)
    safe_du, safe_rise = np.where(good, du, 1.0), np.where(good, rise, 1.0)
    at_edge = along / safe_du[:, None] - (dv / safe_du / safe_rise)[:, None] * to_pole
    square_u[faces] = np.where(good, 0.5 * (at_edge**2).sum(axis=1), np.inf)
    square_v[faces] = np.where(good, (to_pole**2).sum(axis=1) / safe_rise**2, np.inf)
    return square_u, square_v


def pole_faces(faces: Ints, poles: tuple[int, ...]) -> tuple[Ints, Ints, Ints]:
    """Return the faces at poles, their opposite edges (n, 2) in the direction of the face, and their poles."""
    is_pole = np.isin(faces, poles)
    at, corner = np.nonzero(is_pole)
    base = np.column_stack([faces[at, (corner + 1) % 3], faces[at, (corner + 2) % 3]])
    return at, base, faces[at, corner]


def folded_periodic(mesh: TriMesh, uv: Floats, poles: tuple[int, ...]) -> Bools:
    """Return which triangles are turned over or without area in the square, (n_faces,)."""
    return np.isinf(squared_derivatives(mesh, uv, poles)[0])


def periodic_stretch(mesh: TriMesh, uv: Floats, poles: tuple[int, ...]) -> float:
    """Return the L2 stretch of the map, at the best ratio of the units of u and v; 1 for a map that only scales each of them.

    ``sqrt(P Q)^(1/2) / A`` with ``P`` and ``Q`` the integrals of |S_u|^2 and |S_v|^2 over the surface: what the square's stretch
    (Li 2015, eq. 4.8) is after the better of all affine changes of u and v.
    """
    square_u, square_v = squared_derivatives(mesh, uv, poles)
    areas = face_areas(mesh)
    return float(((areas @ square_u) * (areas @ square_v)) ** 0.25 / areas.sum() ** 0.5 / areas.sum() ** 0.5)


def relax(
    wrapped: Wrapped, weights: Floats, uv: Floats, *, eta: float = 0.5, max_iterations: int = 50
) -> Result[Floats]:
    """Relax the stretch of a periodic map, as that of the square (Yoshizawa et al. 2004; Li 2015, eq. 4.6-4.8).

    In each round the weight of an edge is divided by a power of the stretch at both its ends: rows differ from those of the
    square by a common factor only, and the weights stay symmetric, without which a periodic u has no solution.
    """
    mesh, origin = wrapped.opened.mesh, wrapped.opened.origin
    n = int(origin.max()) + 1
    areas = face_areas(mesh)
    corners = origin[mesh.faces].ravel()
    total = np.bincount(corners, np.repeat(areas, 3), n)
    history = [periodic_stretch(mesh, uv, wrapped.poles)]
    status: Status = "out-of-iterations"
    if not np.isfinite(history[0]):
        return Result(uv, "stalled", 0, 1, {"stretch": np.array(history)})
    i, j = wrapped.edges.T
    for _ in range(max_iterations):
        square_u, square_v = squared_derivatives(mesh, uv, wrapped.poles)
        ratio = np.sqrt((areas @ square_v) / (areas @ square_u))
        energy = areas * (ratio * square_u + square_v / ratio)
        sigma = np.sqrt(np.bincount(corners, np.repeat(energy, 3), n) / total)
        sigma /= np.exp(np.log(sigma).mean())
        weights = weights / (sigma[i] * sigma[j]) ** eta
        candidate = solve_periodic(wrapped, weights)
        stretch = periodic_stretch(mesh, candidate, wrapped.poles)
        if not stretch < history[-1]:
            status = "converged"
            break
        uv = candidate
        history.append(stretch)
    return Result(uv, status, len(history) - 1, len(history), {"stretch": np.array(history)})
