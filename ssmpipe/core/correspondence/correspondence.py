"""The dense correspondence of a cohort, as written to ``correspondence.npz``."""

from __future__ import annotations

from dataclasses import dataclass

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.correspondence.window import Window


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Same row, same anatomical place, in every shape.

    Parameters
    ----------
    ids : tuple of str
        Shape ids, sorted; ``n_S`` of them.
    points, points_scan : (n_S, n_P, d)
        Optimized landmarks in the aligned frame [mm, sizes kept] and in the coordinates and units of the scan.
    initial_points, initial_points_scan : (n_S, n_P, d)
        The same before optimization (identity reparameterization).
    transform : (n_S, 4, 4)
        Scan to aligned frame [mm].
    scale : (n_S,)
        Size factor applied inside the objective only.
    parameters : (n_S, n_P, d_par)
        ``D_i(u_l)``.
    grid : tuple of int
        Landmark grid; row-major order of the points.
    faces : (n_F, 3)
        Triangles over the grid, outward.
    topology : {"curve-open", "curve-closed", "disk", "tube", "cone", "closed"}
    reference : int
        Index of the reference shape, -1 when all shapes move.
    description_length : (2,)
        Before and after, at the same ``lambda_cut``; normals included.
    lambda_cut : float
    eigenvalues_initial, eigenvalues : (n_S - 1,)
        Of the covariance inside the objective, normals included, decreasing.
    coefficients : (n_S, n_b1, n_b2, d_par)
        B-spline coefficients of ``D_i``.
    window : Window, optional
        Part of the parameter domain that the landmarks cover, where rims were free.
    normals : (n_S, n_P, d), optional
        Unit normals (curves: tangents) in the aligned frame, where they had a weight.
    normal_scale : float
        What they were multiplied with in the objective [mm].
    """

    ids: tuple[str, ...]
    points: Floats
    points_scan: Floats
    initial_points: Floats
    initial_points_scan: Floats
    transform: Floats
    scale: Floats
    parameters: Floats
    grid: tuple[int, ...]
    faces: Ints
    topology: str
    reference: int
    description_length: Floats
    lambda_cut: float
    eigenvalues_initial: Floats
    eigenvalues: Floats
    coefficients: Floats
    window: Window | None = None
    normals: Floats | None = None
    normal_scale: float = 0.0
