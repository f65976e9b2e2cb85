"""Taubin smoothing: remove noise without shrinking."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ssmpipe.core.mesh.operators import adjacency
from ssmpipe.core.mesh.topology import boundary_half_edges
from ssmpipe.core.mesh.trimesh import TriMesh


def neighbour_average(mesh: TriMesh) -> sparse.csr_matrix:
    """Return the (n_vertices, n_vertices) matrix that averages over neighbours.

    A vertex on the boundary averages its neighbours along the boundary only, so that the rim is smoothed as a curve and
    does not creep inward.
    """
    inner = adjacency(mesh).tocoo()
    half = boundary_half_edges(mesh.faces)
    rim = np.zeros(mesh.n_vertices, dtype=bool)
    rim[half] = True
    keep = ~rim[inner.row]
    rows = np.concatenate([inner.row[keep], half[:, 0], half[:, 1]])
    columns = np.concatenate([inner.col[keep], half[:, 1], half[:, 0]])
    matrix = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=inner.shape)
    degree = np.asarray(matrix.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags(1.0 / np.where(degree > 0, degree, 1.0)) @ matrix)


def taubin(
    mesh: TriMesh, *, n_iterations: int = 10, lam: float = 0.5, mu: float = -0.53, fix_boundary: bool = False
) -> TriMesh:
    """Smooth by alternating a shrinking and a growing Laplacian step (Taubin 1995).

    Parameters
    ----------
    mesh : TriMesh
    n_iterations : int
        Pairs of steps. What counts as noise depends on the edge length: a finer mesh needs more.
    lam, mu : float
        Step sizes, ``0 < lam < -mu``; the pass band ends at ``1 / lam + 1 / mu``.
    fix_boundary : bool
        Whether the boundary stays; otherwise it is smoothed as a curve.

    Returns
    -------
    TriMesh
        Same faces. A plane stays a plane, and affine maps commute with it.
    """
    average = neighbour_average(mesh)
    vertices = np.array(mesh.vertices)
    moving = (np.asarray(average.sum(axis=1)).ravel() > 0)[:, None]
    if fix_boundary:
        moving[boundary_half_edges(mesh.faces)] = False
    for _ in range(n_iterations):
        for step in (lam, mu):
            vertices = vertices + step * np.where(moving, average @ vertices - vertices, 0.0)
    return TriMesh(vertices, mesh.faces)
