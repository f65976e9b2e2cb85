"""Map a disk to the unit square with the least symmetric Dirichlet energy (SLIM)."""

from __future__ import annotations

import igl
import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.operators import area, face_areas
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import square_boundary
from ssmpipe.core.parameterize.distortion import folded, global_stretch, signed_uv_areas, squared_stretch
from ssmpipe.core.parameterize.stretch import parameterize_square, refuse_folds
from ssmpipe.core.parameterize.weights import Weighting
from ssmpipe.core.result import Result, Status

# the rim is held by a penalty; larger ones cost digits of the inner vertices
PENALTY = 1e9


def symmetric_dirichlet(mesh: TriMesh, uv: Floats) -> float:
    """Return the area-weighted mean of ``|J|^2 + |J^-1|^2`` over the triangles, 4 for an isometric map (Rabinovich et al. 2017).

    The square counts with the area of the surface, so that the size of the surface does not matter.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> square = flat_square(5, size=40.0)
    >>> round(symmetric_dirichlet(square, square.vertices[:, :2] / 40.0), 12)
    4.0
    """
    areas = face_areas(mesh)
    if folded(uv, mesh.faces).any():
        return np.inf
    scaled = uv * np.sqrt(areas.sum() / np.abs(signed_uv_areas(uv, mesh.faces)).sum())
    inverse = 2.0 * squared_stretch(mesh, scaled)
    # of two by two matrices: |J| = |J^-1| det J
    determinant = signed_uv_areas(scaled, mesh.faces) / areas
    return float(areas @ (inverse * (1.0 + determinant**2)) / areas.sum())


def parameterize_slim(
    mesh: TriMesh,
    corners: Ints,
    *,
    weighting: Weighting = "mean-value",
    max_iterations: int = 50,
    tolerance: float = 1e-4,
) -> Result[Floats]:
    """Map a disk one-to-one to the unit square by scalable locally injective mappings (Rabinovich et al. 2017; libigl).

    It punishes shrinking as much as stretching, starts from the map of
    :func:`~ssmpipe.core.parameterize.stretch.parameterize_square` before its relaxation, with the same rim, and never folds.

    Parameters
    ----------
    mesh, corners, weighting
        As there.
    max_iterations : int
    tolerance : float
        Ends when the energy falls by less than this share in an iteration [-].

    Returns
    -------
    Result of (n_vertices, 2) float64
        ``history["stretch"]`` and ``history["energy"]`` (:func:`symmetric_dirichlet`) start with the first map.

    Raises
    ------
    FoldoverError
        If a triangle is turned over; says how many and where.
    """
    uv = parameterize_square(mesh, corners, weighting=weighting, max_iterations=0).value
    rim, rim_uv = square_boundary(mesh, corners)
    size = np.sqrt(area(mesh))
    stretch, energy = [global_stretch(mesh, uv)], [symmetric_dirichlet(mesh, uv)]
    status: Status = "out-of-iterations"
    # libigl wants 32-bit indices here and column order; other types are read as garbage
    data = igl.slim_precompute(
        np.asfortranarray(mesh.vertices),
        np.asfortranarray(mesh.faces, dtype=np.int32),
        np.asfortranarray(size * uv),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        np.ascontiguousarray(rim, dtype=np.int32),
        np.asfortranarray(size * rim_uv),
        PENALTY,
    )
    for _ in range(max_iterations):
        candidate = np.array(igl.slim_solve(data, 1))[:, :2] / size
        candidate[rim] = rim_uv
        value = symmetric_dirichlet(mesh, candidate)
        if not value < energy[-1]:
            status = "converged"
            break
        uv = candidate
        stretch.append(global_stretch(mesh, uv))
        energy.append(value)
        if value > (1.0 - tolerance) * energy[-2]:
            status = "converged"
            break
    refuse_folds(mesh, uv, weighting)
    history = {"stretch": np.array(stretch), "energy": np.array(energy)}
    return Result(uv, status, len(stretch) - 1, len(stretch), history)
