"""Map a disk to the unit square with little stretch."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import FoldoverError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import square_boundary
from ssmpipe.core.parameterize.distortion import folded, global_stretch, vertex_stretch
from ssmpipe.core.parameterize.harmonic import solve_averages
from ssmpipe.core.parameterize.weights import Weighting, neighbour_weights
from ssmpipe.core.result import Result, Status


def parameterize_square(
    mesh: TriMesh, corners: Ints, *, weighting: Weighting = "mean-value", eta: float = 0.5, max_iterations: int = 50
) -> Result[Floats]:
    """Map a disk one-to-one to the unit square and relax its stretch (Yoshizawa et al. 2004; Li 2015, eq. 4.1-4.8).

    Each inner vertex is a weighted average of its neighbours. In each round the weights of the neighbours are divided by a power
    of *their* stretch, ``w_jk <- w_jk / sigma(u_k)^eta``, and the map is solved again, as long as the global stretch
    decreases; the last map before it rises is returned. (Division by the row's own stretch would change nothing.)

    Parameters
    ----------
    mesh : TriMesh
        A disk without inner edges between boundary vertices (:func:`~ssmpipe.core.parameterize.boundary.split_chords`).
    corners : (4,) int64
        Boundary vertices in the direction of the rim; they go to (0, 0), (1, 0), (1, 1), (0, 1).
    weighting : {"mean-value", "harmonic", "uniform"}
        Of the first map.
    eta : float
        Exponent [-]; smaller is slower and ends lower.
    max_iterations : int
        Rounds of relaxation at most.

    Returns
    -------
    Result of (n_vertices, 2) float64
        Triangles are counter-clockwise in the square. ``history["stretch"]`` starts with the first map, 1 is isometric.

    Raises
    ------
    FoldoverError
        If a triangle is turned over; says how many and where.
    """
    rim, rim_uv = square_boundary(mesh, corners)
    weights = neighbour_weights(mesh, weighting)
    uv = solve_averages(weights, rim, rim_uv)
    refuse_folds(mesh, uv, weighting)
    history = [global_stretch(mesh, uv)]
    status: Status = "out-of-iterations"
    for _ in range(max_iterations):
        weights = sparse.csr_matrix(weights @ sparse.diags(vertex_stretch(mesh, uv) ** -eta))
        candidate = solve_averages(weights, rim, rim_uv)
        stretch = global_stretch(mesh, candidate)
        if not stretch < history[-1] or folded(candidate, mesh.faces).any():
            status = "converged"
            break
        uv = candidate
        history.append(stretch)
    return Result(uv, status, len(history) - 1, len(history), {"stretch": np.array(history)})


def refuse_folds(mesh: TriMesh, uv: Floats, weighting: Weighting) -> None:
    """Raise a FoldoverError that says where the first triangle is that is turned over in the square."""
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
