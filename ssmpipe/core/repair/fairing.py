"""Smoothing by curvature: implicit bilaplacian and implicit mean curvature flow."""

from __future__ import annotations

from typing import Literal

import igl
import numpy as np
from scipy import sparse

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import mean_edge_length
from ssmpipe.core.mesh.symmetric import solve
from ssmpipe.core.mesh.topology import boundary_half_edges
from ssmpipe.core.mesh.trimesh import TriMesh


def fair(
    mesh: TriMesh,
    *,
    order: Literal["flow", "bilaplacian"],
    cutoff: float,
    rim: Floats | None = None,
) -> TriMesh:
    """Smooth a surface by one implicit step that damps waves shorter than a cut-off.

    A wave of length w is multiplied by ``1 / (1 + (cutoff / w)^2)`` (mean curvature flow, Desbrun et al. 1999) or
    ``1 / (1 + (cutoff / w)^4)`` (bilaplacian): the second leaves long waves, and with them the volume, alone.

    Parameters
    ----------
    mesh : TriMesh
    order : {"flow", "bilaplacian"}
    cutoff : float
        Length of a wave that is halved, in mean edge lengths [-].
    rim : (n_vertices, 3) float64, optional
        Where the boundary vertices go (other rows are not used); by default they stay.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import flat_square
    >>> flat = fair(flat_square(6), order="bilaplacian", cutoff=6.0)
    >>> float(np.abs(flat.vertices[:, 2]).max())
    0.0
    """
    length = cutoff * mean_edge_length(mesh) / (2 * np.pi)
    # slivers make cotangents explode; those of the intrinsic Delaunay triangulation of the same surface are not negative
    stiffness = -sparse.csr_matrix(igl.intrinsic_delaunay_cotmatrix(mesh.vertices, mesh.faces)[0])
    mass = sparse.csr_matrix(igl.massmatrix(mesh.vertices, mesh.faces, igl.MASSMATRIX_TYPE_BARYCENTRIC))
    inverse = sparse.diags(1.0 / np.maximum(mass.diagonal(), 1e-12 * mass.diagonal().max()))
    if order == "flow":
        system = mass + length**2 * stiffness
    else:
        system = mass + length**4 * stiffness @ inverse @ stiffness
    held = np.zeros(mesh.n_vertices, dtype=bool)
    held[boundary_half_edges(mesh.faces)] = True
    free = np.flatnonzero(~held)
    vertices = np.array(mesh.vertices)
    # displacements, so that what is held pulls its surroundings along and far coordinates lose no digits
    shift = np.zeros_like(vertices)
    if rim is not None:
        shift[held] = rim[held] - vertices[held]
    system = sparse.csr_matrix(system)
    right = (mass - system) @ vertices - system @ shift
    shift[free] = solve(system[free][:, free], right[free])
    return TriMesh(vertices + shift, mesh.faces)
