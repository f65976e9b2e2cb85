"""Principal curvatures of a surface at a chosen scale."""

from __future__ import annotations

import igl
import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import mean_edge_length
from ssmpipe.core.mesh.trimesh import TriMesh


def principal_curvatures(mesh: TriMesh, radius: float) -> Floats:
    """Return the larger and the smaller principal curvature at the vertices, (n_vertices, 2) [1/mm].

    Positive where the surface bulges outward. From a quadric fitted to the vertices within ``radius`` (Panozzo et al. 2010).

    Parameters
    ----------
    mesh : TriMesh
        Outward.
    radius : float
        Of the neighbourhood [mm]; at least five mean edge lengths, where the fit becomes unstable below.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> bool(np.abs(principal_curvatures(sphere(10.0, 4), 4.0) - 0.1).max() < 0.01)
    True
    """
    edges = max(5, round(radius / mean_edge_length(mesh)))
    _, _, first, second, _ = igl.principal_curvature(mesh.vertices, mesh.faces, edges, False)
    both = np.sort(np.column_stack([np.ravel(first), np.ravel(second)]), axis=1)
    return np.asarray(both[:, ::-1])
