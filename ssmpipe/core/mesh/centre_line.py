"""The centre line of a tube, from one end to the other."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.operators import edge_lengths
from ssmpipe.core.mesh.sections import level_segments
from ssmpipe.core.mesh.symmetric import solve
from ssmpipe.core.mesh.topology import unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh


def centre_line(mesh: TriMesh, start: Ints, end: Ints, n_levels: int = 80) -> Floats:
    """Return the centres of the level curves of a field that rises from one end to the other, (n, 3) [mm].

    The field is harmonic on the edge graph, conductance one over edge length; it has no extremum in between, so that every
    level curve goes around the tube. Levels are spaced so that their centres lie about equally far apart.

    Parameters
    ----------
    mesh : TriMesh
        A tube of one component; other holes do no harm.
    start, end : (n,) int64
        Vertices where the field is 0 and 1, such as the two rims, or a single vertex.
    n_levels : int

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import tube
    >>> from ssmpipe.core.mesh.topology import boundary_loops
    >>> pipe = tube(radius=2.0, height=10.0)
    >>> line = centre_line(pipe, *boundary_loops(pipe.faces))
    >>> bool(np.abs(line[:, :2]).max() < 1e-12), bool(np.ptp(line[:, 2]) > 9.0)
    (True, True)
    """
    field = _rising_field(mesh, start, end)
    levels = (np.arange(n_levels) + 0.5) / n_levels
    line = _centres(mesh, field, levels)
    for _ in range(2):
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
        even = np.linspace(0.0, length[-1], n_levels)
        levels = np.interp(even, length, levels)
        line = _centres(mesh, field, levels)
    return line


def _rising_field(mesh: TriMesh, start: Ints, end: Ints) -> Floats:
    edges = unique_edges(mesh.faces).vertices
    length = edge_lengths(mesh, edges)
    conductance = 1.0 / np.maximum(length, 1e-3 * float(length.mean()))
    i, j = edges.T
    n = mesh.n_vertices
    weights = sparse.csr_matrix((np.r_[conductance, conductance], (np.r_[i, j], np.r_[j, i])), shape=(n, n))
    laplacian = sparse.csr_matrix(sparse.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights)
    field = np.zeros(n)
    field[end] = 1.0
    used = np.bincount(mesh.faces.ravel(), minlength=n) > 0
    free = np.setdiff1d(np.flatnonzero(used), np.r_[start, end])
    field[free] = solve(laplacian[free][:, free], -(laplacian[free] @ field))
    return field


def _centres(mesh: TriMesh, field: Floats, levels: Floats) -> Floats:
    centres = []
    for level in levels:
        segments = level_segments(mesh, field - level)
        length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
        centres.append(length @ segments.mean(axis=1) / length.sum())
    return np.array(centres)
