"""Read a mapped surface at a regular grid of the square."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import interpolate, point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh


def sample_grid(mesh: TriMesh, uv: Floats, n_u: int, n_v: int) -> Floats:
    """Return the surface points at ``(i / (n_u - 1), j / (n_v - 1))``, (n_u, n_v, 3) [mm] (Li 2015, eq. 4.9-4.10).

    Raises
    ------
    GeometryError
        If the map does not cover the square.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(4, size=6.0)
    >>> sample_grid(square, square.vertices[:, :2] / 6.0, 2, 3)[1, 1]
    array([6., 3., 0.])
    """
    u, v = np.meshgrid(np.linspace(0.0, 1.0, n_u), np.linspace(0.0, 1.0, n_v), indexing="ij")
    wanted = np.column_stack([u.ravel(), v.ravel(), np.zeros(n_u * n_v)])
    # libigl's own 2-D point location aborts the process; the plane z = 0 in space is safe
    flat = TriMesh(np.column_stack([uv, np.zeros(len(uv))]), mesh.faces)
    gap, face, weights = point_to_mesh(wanted, flat)
    if gap.max() > 1e-6:
        missed = int((gap > 1e-6).sum())
        raise GeometryError(
            f"{missed} of {n_u * n_v} grid points lie outside the mapped surface, the farthest by {gap.max():.2g} of the square's side",
            "parameterize the surface to the whole unit square",
        )
    return interpolate(mesh.vertices, mesh, face, weights).reshape(n_u, n_v, 3)
