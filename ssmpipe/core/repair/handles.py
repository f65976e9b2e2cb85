"""Cut small handles: bridges between two places of a surface, and tunnels through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import mean_edge_length
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, genus, handle_loop, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.replacing import closed_again, new_loops
from ssmpipe.core.repair.stump import Stump, remove, stump_base

REACH = 2.0
"""How far the ends of a bridge or tunnel are looked for from its loop, in lengths of the longest loop [-]."""


@dataclass(frozen=True)
class CutHandle:
    """What was cut.

    Attributes
    ----------
    place : tuple of float
        Middle of the loop [mm].
    length : float
        Of the loop along which the handle was cut [mm].
    reach : float
        How far from the loop the surface was removed before it was closed, on the surface [mm].
    """

    place: tuple[float, float, float]
    length: float
    reach: float


def cut_handles(mesh: TriMesh, max_length: float) -> tuple[TriMesh, list[CutHandle]]:
    """Cut handles along short loops that do not bound, and close both sides; each cut lowers the genus by one.

    A loop around a bridge cuts the bridge, a loop inside a tunnel closes the tunnel: whichever is shorter. What is left of the
    bridge on both sides, or of the tunnel, is removed to where its girth opens, so that no stumps remain.

    Parameters
    ----------
    mesh : TriMesh
        Oriented manifold of one component.
    max_length : float
        Handles whose loop is longer stay [mm].

    Returns
    -------
    mesh : TriMesh
        The vertices away from the cuts stay to the bit.
    cuts : list of CutHandle
        In the order of the cuts, the shortest loop that was found first.

    Raises
    ------
    TopologyError
        If a loop that is short enough cannot be cut and closed.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import torus
    >>> cut, cuts = cut_handles(torus(6.0, 1.0, 96, 24), max_length=8.0)
    >>> genus(cut.faces), len(cuts)
    (0, 1)
    """
    cuts: list[CutHandle] = []
    while genus(mesh.faces) > 0:
        closed = close_openings(mesh)
        rims = boundary_loops(mesh.faces)
        avoid = np.r_[np.concatenate(rims) if rims else [], np.arange(mesh.n_vertices, closed.n_vertices)]
        loop = handle_loop(closed, avoid=avoid.astype(np.int64))
        if loop is None or loop_length(closed, loop) > max_length or np.isin(loop, avoid).any():
            break
        mesh, cut = _cut(mesh, loop, max_length)
        cuts.append(cut)
    return mesh, cuts


def _cut(mesh: TriMesh, loop: Ints, max_length: float) -> tuple[TriMesh, CutHandle]:
    length = loop_length(mesh, loop)
    x, y, z = (float(c) for c in mesh.vertices[loop].mean(axis=0))
    margin = max(2.0 * mean_edge_length(mesh), length / (2 * np.pi))
    euler = euler_characteristic(mesh.faces) + 2
    for share in (1.0, 0.5, 0.0):
        try:
            opened = _opened(mesh, loop, REACH * max_length, share * margin)
            if opened is None:
                continue
            return closed_again(opened[0], mesh, euler), CutHandle((x, y, z), length, opened[1])
        except (TopologyError, GeometryError):
            continue
    raise TopologyError(
        f"the handle with a loop of {length:.1f} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm could not be cut and closed",
        "lower repair.max_handle_mm to have its place reported, and cut it in the segmentation",
    )


def _opened(mesh: TriMesh, loop: Ints, reach: float, margin: float) -> tuple[TriMesh, float] | None:
    """Remove the faces at a loop and, on both sides, up to the base; return the mesh and the reach."""
    torn = remove(mesh, [Stump(loop, 0.0)])
    new = new_loops(torn, mesh)
    if len(new) != 2:
        return None
    stumps = []
    for rim in new:
        try:
            base = stump_base(torn, rim, reach)
        except TopologyError:  # a long bridge: its rest is closed where it was cut
            base = None
        stumps.append(Stump(rim, margin + (base or 0.0)))
    farthest = max(stump.length for stump in stumps)
    if farthest > 0:
        torn = remove(torn, stumps)
    apart = len(new_loops(torn, mesh)) == 2 and euler_characteristic(torn.faces) == euler_characteristic(mesh.faces)
    return (torn, farthest) if apart else None
