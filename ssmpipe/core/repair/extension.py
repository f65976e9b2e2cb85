"""Continue a surface beyond its rim by the curvature that it has there."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.distance import interpolate, point_to_mesh
from ssmpipe.core.mesh.operators import mean_edge_length, vertex_normals
from ssmpipe.core.mesh.topology import boundary_loops, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.trimming import trim

CUBIC = 0.5
"""A cubic continues the course when it leaves less than this share of what a quadratic leaves: not where noise rules [-]."""

FIT_MM = 6.0
"""Length of the strip inside the rim whose course is continued [mm]."""


def extend(mesh: TriMesh, loop: Ints, direction: Floats, length: float, *, fit: float = FIT_MM) -> TriMesh:
    """Add a strip of a given length to a clean rim.

    From every vertex of the rim a path is followed inward on the surface, opposite to ``direction``. A quadratic in the arc
    length is fitted to it (a cubic where that leaves less than half: on smooth scans), its coefficients are smoothed around the
    rim by a Fourier series with waves no shorter than ``fit``, and it is evaluated outward. The new rim is not planar: cut it
    afterwards.

    Parameters
    ----------
    mesh : TriMesh
    loop : (n,) int64
        The rim, surface on its left (see :func:`ssmpipe.core.mesh.topology.boundary_loops`); without ragged edges.
    direction : (3,) float64
        Outward across the rim.
    length : float
        Of the strip [mm].
    fit : float
        Length of the paths [mm].

    Returns
    -------
    TriMesh
        Same topology; the old vertices and faces come first.

    Raises
    ------
    TopologyError
        If the surface ends within ``fit`` of the rim: there is nothing to continue.
    """
    outward = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    paths, at = _march_inward(mesh, mesh.vertices[loop], outward, fit)
    coefficients = _course(paths, at / fit)
    n_powers = len(coefficients[0])
    rim = mesh.vertices[loop]
    around = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(rim, axis=0), axis=1))]
    total = loop_length(mesh, loop)
    waves = np.arange(1, max(3, int(total / fit)) + 1)
    waves = waves[: max(1, (len(loop) - 1) // 4)]
    phase = 2 * np.pi * np.outer(around / total, waves)
    basis = np.hstack([np.ones((len(loop), 1)), np.cos(phase), np.sin(phase)])
    rest = coefficients[:, 1:].reshape(len(loop), -1)
    smooth = (basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]).reshape(len(loop), n_powers - 1, 3)

    step = total / len(loop)
    n_rings = max(1, int(np.ceil(length / step)))
    distance = np.linspace(0.0, length, n_rings + 1)[1:, None, None] / fit
    start = coefficients[:, 0]
    # what the fit misses at the rim itself fades out over the first millimetres
    fading = np.clip(1.0 - 2.0 * distance, 0.0, None)
    rings = start + fading * (rim - start)
    for power in range(1, n_powers):
        rings = rings + distance**power * smooth[:, power - 1]
    n = len(loop)
    index = np.vstack([loop, mesh.n_vertices + np.arange(n_rings * n).reshape(n_rings, n)])
    a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
    c, d = index[1:], np.roll(index, -1, axis=1)[1:]
    a, b, c, d = a.ravel(), b.ravel(), c.ravel(), d.ravel()
    vertices = np.vstack([mesh.vertices, rings.reshape(-1, 3)])
    # the shorter diagonal, the same one in the mirror image; of equal ones always the same, whatever rounding says
    ad, bc = (np.linalg.norm(vertices[x] - vertices[y], axis=1) for x, y in ((a, d), (b, c)))
    last, first = np.where(ad < (1.0 - 1e-9) * bc, [d, a], [c, b])
    strip = np.vstack([np.column_stack([b, a, last]), np.column_stack([first, c, d])])
    return TriMesh(vertices, np.vstack([mesh.faces, strip]))


def _course(paths: Floats, at: Floats) -> Floats:
    """Fit a polynomial to every path: quadratic, or cubic where that leaves much less; (n, 3 or 4, 3), constant term first."""
    fits, left = [], []
    for degree in (2, 3):
        powers = np.stack([at**power for power in range(degree + 1)], axis=-1)
        normal = np.einsum("kni,knj->nij", powers, powers)
        fitted = np.linalg.solve(normal, np.einsum("kni,knd->nid", powers, paths))
        fits.append(fitted)
        left.append(float(np.sqrt(((np.einsum("kni,nid->knd", powers, fitted) - paths) ** 2).sum(axis=2).mean())))
    return fits[int(left[1] < CUBIC * left[0])]


def trim_or_extend(
    mesh: TriMesh, point: Floats, normal: Floats, *, snap: float = 0.1, extend_mm: float = 0.0
) -> tuple[TriMesh, float]:
    """Trim to a disk (see :func:`ssmpipe.core.repair.trimming.trim`); continue the scan first where it ends before the plane.

    Returns
    -------
    mesh : TriMesh
    added : float
        By how much the scan was continued [mm]; zero if it reached the plane.

    Raises
    ------
    TopologyError
        If more than ``extend_mm`` are missing, and as ``trim``.
    """
    direction = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    loops = boundary_loops(mesh.faces)
    missing = max((-float(((mesh.vertices[loop] - point) @ direction).min()) for loop in loops), default=0.0)
    if len(loops) != 1 or not 0 < missing <= extend_mm:
        return trim(mesh, point, direction, snap=snap), 0.0
    step = mean_edge_length(mesh)
    clean = trim(mesh, point - (missing + 0.2 * step) * direction, direction, snap=snap)
    longer = extend(clean, boundary_loops(clean.faces)[0], direction, 1.5 * missing + 2.0 * step)
    return trim(longer, point, direction, snap=snap), missing


def _march_inward(
    mesh: TriMesh, points: Floats, outward: Floats, fit: float, n_steps: int = 16
) -> tuple[Floats, Floats]:
    """Return positions (n_steps + 1, n, 3) along the surface and their arc lengths (n_steps + 1, n), negative inward.

    The direction of a step is that of the normals at the vertices, interpolated: continuous on the surface, so that it does not
    depend on which of the faces at an edge or a vertex (every path starts in one) is taken for the nearest.
    """
    normals = vertex_normals(mesh)
    positions, lengths = [points], [np.zeros(len(points))]
    _, face, weights = point_to_mesh(points, mesh)
    for _ in range(n_steps):
        normal = interpolate(normals, mesh, face, weights)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        tangent = (normal @ outward)[:, None] * normal - outward
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        _, face, weights = point_to_mesh(positions[-1] + fit / n_steps * tangent, mesh)
        reached = interpolate(mesh.vertices, mesh, face, weights)
        lengths.append(lengths[-1] - np.linalg.norm(reached - positions[-1], axis=1))
        positions.append(reached)
    if float(-lengths[-1].max()) < 0.5 * fit:
        raise TopologyError(
            f"the surface ends {float(-lengths[-1].max()):.1f} mm inside its rim, {fit:.0f} mm are needed to continue it",
            "move the cut to where the scan reaches",
        )
    return np.array(positions), np.array(lengths)
