"""How far one surface (or curve) lies from another: figures per direction, by area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.evaluation.locating import locate
from ssmpipe.core.mesh.distance import sample_surface, signed_point_to_mesh
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.topology import unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.fit import surface_grid
from ssmpipe.core.spline.fit_curve import curve_points
from ssmpipe.core.spline.surface import BSplineSurface

_ON_EDGE = 1e-9  # barycentric coordinate below which a place lies on the opposite edge


@dataclass(frozen=True, eq=False)
class Geometry:
    """A surface of triangles or a curve of edges.

    Parameters
    ----------
    points : (n, d) float64
        [mm].
    cells : (n_F, 3) or (n_E, 2) int64

    Examples
    --------
    >>> Geometry(np.array([[0, 0], [3.0, 4]]), np.array([[0, 1]])).diagonal
    5.0
    """

    points: Floats
    cells: Ints

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box [mm]."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def moved(self, matrix: Floats) -> Geometry:
        """Return it moved by a (4, 4) homogeneous matrix, of which a planar curve uses the part in the plane.

        Triangles are turned over when the matrix mirrors, so that the outside stays outside.
        """
        d = self.points.shape[1]
        mirrored = self.cells.shape[1] == 3 and np.linalg.det(matrix[:3, :3]) < 0
        return Geometry(self.points @ matrix[:d, :d].T + matrix[:d, 3], self.cells[:, ::-1] if mirrored else self.cells)


@dataclass(frozen=True)
class Distances:
    """Distances of one direction [mm]; mean, median and 99th percentile weigh by area (or length)."""

    mean: float
    median: float
    p99: float
    maximum: float


def even_points(geometry: Geometry, n: int) -> Floats:
    """Return ``n`` points spread evenly over the area, or the length, of a geometry; the same ones every time.

    Examples
    --------
    >>> even_points(Geometry(np.array([[0, 0], [4.0, 0]]), np.array([[0, 1]])), 2)
    array([[1., 0.],
           [3., 0.]])
    """
    if geometry.cells.shape[1] == 3:
        return sample_surface(TriMesh(geometry.points, geometry.cells), n, seed=0)[0]
    start, end = (geometry.points[geometry.cells[:, k]] for k in (0, 1))
    sums = np.concatenate([[0.0], np.cumsum(np.linalg.norm(end - start, axis=1))])
    at = (np.arange(n) + 0.5) / n * sums[-1]
    cell = np.clip(np.searchsorted(sums, at, side="right") - 1, 0, len(start) - 1)
    share = (at - sums[cell]) / np.maximum(sums[cell + 1] - sums[cell], np.finfo(float).tiny)
    return np.asarray(start[cell] + share[:, None] * (end - start)[cell])


def facing(points: Floats, target: Geometry) -> Bools:
    """Say which points face a surface: those whose nearest place is not on its rim. The others lie beyond it.

    Parameters
    ----------
    points : (n, 3) float64
    target : Geometry
        Triangles; a closed surface faces all points.

    Examples
    --------
    >>> square = Geometry(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    >>> facing(np.array([[0.5, 0.5, 3], [0.2, 0.9, 1], [0.5, 1.5, 0], [2, 2, 0]]), square)
    array([ True,  True, False, False])
    """
    edges = unique_edges(target.cells)
    rim = np.sort(edges.vertices[edges.n_faces == 1], axis=1)
    n = len(target.points)
    _, face, weights = locate(points, target.points, target.cells)
    used = weights > _ON_EDGE
    corners = np.sort(np.where(used, target.cells[face], -1), axis=1)
    first = np.where(corners[:, 1] < 0, corners[:, 2], corners[:, 1])  # a corner: twice itself
    on_edge = np.isin(first * n + corners[:, 2], rim[:, 0] * n + rim[:, 1])
    at_corner = (corners[:, 1] < 0) & np.isin(corners[:, 2], rim)
    return np.asarray(used.all(axis=1) | ~(on_edge | at_corner))


def distances(source: Geometry, target: Geometry, n_samples: int = 10000, *, beyond: bool = True) -> Distances:
    """Measure from the points of ``source`` to the nearest place on ``target`` (to the surface, not to its vertices).

    Parameters
    ----------
    source, target : Geometry
    n_samples : int, default=10000
        Points spread evenly over the source for mean, median and percentile; its vertices join them for the maximum.
    beyond : bool, default=True
        Count the points that lie beyond the rim of the target as well (see :func:`facing`); where all do, they count in any case.

    Examples
    --------
    >>> square = Geometry(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    >>> distances(square, Geometry(square.points + [0, 0, 2], square.cells), 10)
    Distances(mean=2.0, median=2.0, p99=2.0, maximum=2.0)
    """
    points = np.concatenate([even_points(source, n_samples), source.points])
    found = locate(points, target.points, target.cells)[0]
    even = found[:n_samples]
    if not beyond:
        kept = facing(points, target)
        if kept[:n_samples].any():
            found, even = found[kept], even[kept[:n_samples]]
    return Distances(float(even.mean()), float(np.median(even)), float(np.percentile(even, 99)), float(found.max()))


def signed_distances(points: Floats, target: Geometry) -> Floats:
    """Return the distance of every point from a surface, negative on the inner side of the nearest face; plain from a curve.

    Examples
    --------
    >>> flat = Geometry(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    >>> signed_distances(np.array([[0.2, 0.2, 0.5], [0.2, 0.2, -0.5]]), flat)
    array([ 0.5, -0.5])
    """
    if target.cells.shape[1] != 3:
        return locate(points, target.points, target.cells)[0]
    return signed_point_to_mesh(points, TriMesh(target.points, target.cells))


def dense_spline(spline: BSplineSurface | BSplineCurve) -> Geometry:
    """Return a spline as triangles or edges, four per control point and direction (twenty on a curve).

    Examples
    --------
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0.0, 0], [2, 0]]))
    >>> len(dense_spline(line).cells)
    40
    """
    if isinstance(spline, BSplineCurve):
        points = curve_points(spline, np.linspace(0.0, 1.0, 20 * len(spline.control_points) + 1))
        return Geometry(points, edge_indices(len(points), False))
    n_u, n_v = (4 * n + 1 for n in spline.control_points.shape[:2])
    grid = surface_grid(spline, n_u, n_v).reshape(n_u * n_v, -1)
    if grid.shape[1] == 2:
        grid = np.pad(grid, ((0, 0), (0, 1)))
    return Geometry(grid, grid_faces(n_u, n_v))
