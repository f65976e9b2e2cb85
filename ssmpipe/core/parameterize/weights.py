"""Weights that make each vertex an average of its neighbours."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import sparse

from ssmpipe.core.mesh.operators import adjacency
from ssmpipe.core.mesh.trimesh import TriMesh

Weighting = Literal["mean-value", "harmonic", "uniform"]


def neighbour_weights(mesh: TriMesh, weighting: Weighting) -> sparse.csr_matrix:
    """Return unnormalized weights ``w_jk`` of the neighbours k of vertex j, (n_vertices, n_vertices).

    - ``mean-value`` (Floater 2003): ``(tan(a/2) + tan(b/2)) / |p_j - p_k|``, a and b the angles at j beside the edge;
      always positive, so the map to a convex region is one-to-one
    - ``harmonic`` (Pinkall and Polthier 1993): ``(cot a + cot b) / 2``, the angles opposite to the edge; negative where
      they add up to more than 180 degrees, then the map may fold
    - ``uniform`` (Tutte 1963): one

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> neighbour_weights(flat_square(3), "uniform").sum(axis=1).max()
    np.float64(6.0)
    """
    if weighting == "uniform":
        return adjacency(mesh)
    tiny = np.finfo(np.float64).tiny
    rows, columns, values = [], [], []
    for k in range(3):
        i, j, l = mesh.faces[:, k], mesh.faces[:, (k + 1) % 3], mesh.faces[:, (k + 2) % 3]
        e, f = mesh.vertices[j] - mesh.vertices[i], mesh.vertices[l] - mesh.vertices[i]
        length_e, length_f = np.linalg.norm(e, axis=1), np.linalg.norm(f, axis=1)
        cross, dot = np.linalg.norm(np.cross(e, f), axis=1), np.einsum("ij,ij->i", e, f)
        if weighting == "mean-value":
            # tan(x / 2) = sin x / (1 + cos x); bounded where a sliver opens to 180 degrees
            half = cross / np.maximum(length_e * length_f + dot, 1e-12 * length_e * length_f + tiny)
            rows += [i, i]
            columns += [j, l]
            values += [half / np.maximum(length_e, tiny), half / np.maximum(length_f, tiny)]
        else:
            cotangent = 0.5 * dot / np.maximum(cross, 1e-12 * length_e * length_f + tiny)
            rows += [j, l]
            columns += [l, j]
            values += [cotangent, cotangent]
    n = mesh.n_vertices
    return sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
