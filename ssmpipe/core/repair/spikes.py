"""Find and remove needles that stand out of a surface: noise of the scanner, not anatomy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import adjacency, edge_lengths
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.replacing import closed_again, new_loops
from ssmpipe.core.repair.smoothing import neighbour_average
from ssmpipe.core.repair.stump import Stump, distance_from, girths, remove

NARROW, OPENING = 0.3 * 2 * np.pi, 0.5 * 2 * np.pi
"""Growth of the girth per length: below the first on a needle, above the second at its base; in a plane 2 pi [-]."""

MIN_LENGTH = 3.0
"""Shortest needle, in median edge lengths: less is roughness, which smoothing removes [-]."""

N_SMOOTH, STANDING_OUT = 12, 1.0
"""A tip stands out of a smoothed copy (Laplacian iterations) by more than this many edges, and more than its neighbours."""


@dataclass(frozen=True)
class Spike:
    """A needle.

    Attributes
    ----------
    tip : int
        Vertex at its end.
    place : tuple of float
        Position of the tip [mm].
    length, width : float
        From the tip to the base along the surface, and the diameter of the widest section before the base [mm].
    """

    tip: int
    place: tuple[float, float, float]
    length: float
    width: float


def find_spikes(mesh: TriMesh, *, max_width: float = 4.0, min_slenderness: float = 1.5) -> list[Spike]:
    """Find needles: narrower than a few edges, and longer than wide.

    From a tip, the lines at equal distance along the surface have a girth. On a needle it stays small and opens at the base; on
    a ridge or the edge of a thin wall it grows from the start as in a plane, because both sides of the wall count.

    Parameters
    ----------
    mesh : TriMesh
    max_width : float
        Widest needle, in median edge lengths of the mesh [-].
    min_slenderness : float
        Least length over width [-].

    Returns
    -------
    list of Spike
        The longest first.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> ball = sphere(10.0, 4)
    >>> vertices = ball.vertices.copy()
    >>> vertices[100] *= 1.5
    >>> [round(spike.length, 1) for spike in find_spikes(TriMesh(vertices, ball.faces))]
    [5.3]
    """
    spacing = _spacing(mesh)
    widest = max_width * spacing
    spikes: list[Spike] = []
    claimed = np.zeros(mesh.n_vertices, dtype=bool)
    around = _Surroundings(mesh)
    for tip in _tips(mesh, spacing):
        if claimed[tip] or _opens_at_once(around, int(tip), spacing, widest):
            continue
        for reach in (2.0 * widest, 4.0 * widest, 12.0 * widest):
            part, used, distance = around.within(int(tip), reach)
            length, width = _base(part, distance, spacing, widest)
            if np.isfinite(length) or width > widest:
                break
        if width > widest or not max(min_slenderness * width, MIN_LENGTH * spacing) <= length < np.inf:
            continue
        claimed[used[distance <= length]] = True
        x, y, z = (float(c) for c in mesh.vertices[tip])
        spikes.append(Spike(int(tip), (x, y, z), length, width))
    return sorted(spikes, key=lambda spike: (-spike.length, spike.place))


def remove_spikes(mesh: TriMesh, spikes: list[Spike]) -> tuple[TriMesh, list[Spike]]:
    """Remove needles down to their bases and close the holes.

    Returns
    -------
    mesh : TriMesh
        The vertices away from the needles stay to the bit.
    removed : list of Spike
        Those that could be removed; one whose hole cannot be closed, or that sits on a rim, stays.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> ball = sphere(10.0, 4)
    >>> vertices = ball.vertices.copy()
    >>> vertices[100] *= 1.5
    >>> hurt = TriMesh(vertices, ball.faces)
    >>> smooth, removed = remove_spikes(hurt, find_spikes(hurt))
    >>> len(removed), bool(np.linalg.norm(smooth.vertices, axis=1).max() < 10.5)
    (1, True)
    """
    removed = []
    spacing = _spacing(mesh)
    points = [np.array(spike.place) for spike in spikes]
    for spike, point in zip(spikes, points, strict=True):
        tip = int(np.argmin(((mesh.vertices - point) ** 2).sum(axis=1)))
        if not np.array_equal(mesh.vertices[tip], point):
            continue  # went with another one
        try:
            mesh = _without(mesh, tip, spike.length + spacing)
        except (TopologyError, GeometryError):
            continue
        removed.append(spike)
    return mesh, removed


def _without(mesh: TriMesh, tip: int, length: float) -> TriMesh:
    torn = remove(mesh, [Stump(np.array([tip]), length)])
    if len(new_loops(torn, mesh)) != 1:
        raise TopologyError("removing a spike does not open one hole")
    return closed_again(torn, mesh, euler_characteristic(mesh.faces))


def _tips(mesh: TriMesh, spacing: float) -> Ints:
    """Return vertices that stand out of a smoothed copy, and more so than their neighbours, the farthest first."""
    average = neighbour_average(mesh)
    moving = np.asarray(average.sum(axis=1)).ravel() > 0
    smooth = np.array(mesh.vertices)
    for _ in range(N_SMOOTH):
        smooth = np.where(moving[:, None], 0.5 * smooth + 0.5 * (average @ smooth), smooth)
    away = np.linalg.norm(mesh.vertices - smooth, axis=1)
    neighbours = adjacency(mesh)
    around = np.asarray(neighbours.multiply(away[None, :]).tocsr().max(axis=1).todense()).ravel()
    tip = np.flatnonzero((away > STANDING_OUT * spacing) & (away >= around) & ~_rim(mesh))
    return tip[np.argsort(-away[tip], kind="stable")]


def _spacing(mesh: TriMesh) -> float:
    return float(np.median(edge_lengths(mesh, unique_edges(mesh.faces).vertices)))


def _rim(mesh: TriMesh) -> Bools:
    rim = np.zeros(mesh.n_vertices, dtype=bool)
    for loop in boundary_loops(mesh.faces):
        rim[loop] = True
    return rim


class _Surroundings:
    """Parts of a mesh around its vertices, found without a pass over the whole mesh."""

    def __init__(self, mesh: TriMesh) -> None:
        self.mesh = mesh
        self.tree = cKDTree(mesh.vertices)
        self.incident = np.argsort(mesh.faces.ravel(), kind="stable") // 3
        self.first = np.r_[0, np.cumsum(np.bincount(mesh.faces.ravel(), minlength=mesh.n_vertices))]

    def within(self, tip: int, reach: float) -> tuple[TriMesh, Ints, Floats]:
        """Return what may lie within reach on the surface, its vertices' old numbers, and their distances along edges [mm]."""
        # nothing is nearer along edges than in a straight line
        near = self.tree.query_ball_point(self.mesh.vertices[tip], (1.0 + 1e-9) * reach)
        kept = np.unique(np.concatenate([self.incident[self.first[v] : self.first[v + 1]] for v in near]))
        used, faces = np.unique(self.mesh.faces[kept], return_inverse=True)
        part = TriMesh(self.mesh.vertices[used], faces.reshape(-1, 3))
        return part, used, distance_from(part, np.searchsorted(used, [tip]), reach)


def _opens_at_once(around: _Surroundings, tip: int, spacing: float, widest: float) -> bool:
    """Say, without looking far, that a needle of the least length would be too wide."""
    level = (MIN_LENGTH - 0.5) * spacing
    part, _, distance = around.within(tip, level + spacing)
    return float(girths(part, distance, np.array([level]))[0]) > np.pi * widest


def _base(mesh: TriMesh, distance: Floats, spacing: float, widest: float) -> tuple[float, float]:
    """Return the length and width of the needle at whose tip distance is zero.

    The length is infinite where no base was found, the width then that of the widest section before the end or ``widest``.
    """
    near = distance[np.isfinite(distance)].max()
    levels = np.arange(0.5 * spacing, near, 0.5 * spacing)
    if len(levels) < 4:
        return np.inf, 0.0
    girth = girths(mesh, distance, levels)
    slope = (girth[2:] - girth[:-2]) / (levels[2:] - levels[:-2])
    # the round end of a needle opens too: first it must have become narrow
    width, narrow = 0.0, False
    for k in range(1, len(levels) - 1):
        width = max(width, float(girth[k - 1] / np.pi))
        if width > widest:
            break
        narrow |= bool(slope[k - 1] < NARROW)
        if narrow and slope[k - 1] > OPENING:
            return float(levels[k]), width
    return np.inf, width
