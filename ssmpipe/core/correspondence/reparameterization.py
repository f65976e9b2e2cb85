"""The reparameterization ``D`` of the unit interval or square: a B-spline whose coefficients are the unknowns."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.correspondence.direction import Direction, apply_directions, components_first, components_last
from ssmpipe.core.correspondence.window import Window, whole
from ssmpipe.core.errors import GeometryError

Boundary = Literal["fixed", "sliding", "periodic"]


class Reparameterization:
    """Evaluate ``D_i(u_l)`` [2.2, 2.3 of Li 2015] at tensor nodes for many shapes at once, and pull gradients back.

    Internally ``D = id + displacement``, so that the identity has no displacement in every boundary mode. With a window, ``id`` is
    the affine map onto it.

    Parameters
    ----------
    n_coefficients : tuple of int
        Coefficients of ``D`` per direction; one number for curves, two for surfaces.
    nodes : tuple of int or of (n,) arrays
        Landmarks per direction: a number for evenly spaced ones (ends included, except that a periodic direction leaves
        out u = 1), or the nodes themselves.
    degree : int, default=2
    boundary : {"fixed", "sliding", "periodic"}, default="fixed"
        ``fixed``: ``D`` is the identity on the boundary [2.4]. ``sliding``: every edge is mapped onto itself, but points
        may slide along it; the corners stay (on a curve the same as ``fixed``). ``periodic``: the first direction is an
        angle, ``D(u + 1) = D(u) + 1``, so the starting point is free; on a surface the two rims ``v = 0, 1`` are mapped
        onto themselves and may turn.

    Attributes
    ----------
    free : (*n_coefficients, d_par) bool
        Which coefficients are unknowns.

    Examples
    --------
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> D.evaluate(D.identity()[None])[0, :3]
    array([[0. , 0. ],
           [0. , 0.5],
           [0. , 1. ]])
    """

    def __init__(
        self,
        n_coefficients: tuple[int, ...],
        nodes: tuple[int, ...] | tuple[Floats, ...],
        *,
        degree: int = 2,
        boundary: Boundary = "fixed",
        window: Window | None = None,
    ) -> None:
        if len(n_coefficients) != len(nodes) or len(nodes) not in (1, 2):
            raise GeometryError(
                f"coefficients for {len(n_coefficients)} and nodes for {len(nodes)} directions; need the same, 1 or 2"
            )
        self.degree = degree
        self.boundary = boundary
        self.window = window or whole(len(nodes))
        self.periodic = tuple(boundary == "periodic" and axis == 0 for axis in range(len(nodes)))
        self.directions = tuple(Direction(n, degree, p) for n, p in zip(n_coefficients, self.periodic, strict=True))
        self.nodes = tuple(
            np.linspace(0.0, 1.0, n, endpoint=not p) if isinstance(n, int) else np.asarray(n)
            for n, p in zip(nodes, self.periodic, strict=True)
        )
        self.grid = tuple(len(n) for n in self.nodes)
        self._basis = tuple(d.matrix(n) for d, n in zip(self.directions, self.nodes, strict=True))
        self._slope = tuple(d.matrix(n, 1) for d, n in zip(self.directions, self.nodes, strict=True))
        at = np.stack(np.meshgrid(*self.nodes, indexing="ij"), axis=-1)
        self._at = np.ascontiguousarray(components_first(self.window.image(at)[None])[0])
        identity = np.stack(np.meshgrid(*[d.identity for d in self.directions], indexing="ij"), axis=-1)
        self._identity = self.window.image(identity)
        self.free = free_coefficients(n_coefficients, boundary, self.window)

    @property
    def n_coefficients(self) -> tuple[int, ...]:
        """Coefficients per direction."""
        return tuple(d.n_coefficients for d in self.directions)

    @property
    def n_directions(self) -> int:
        """1 for curves, 2 for surfaces."""
        return len(self.directions)

    def at(self, nodes: tuple[int, ...] | tuple[Floats, ...]) -> Reparameterization:
        """Return the same space of maps with other nodes."""
        return Reparameterization(
            self.n_coefficients, nodes, degree=self.degree, boundary=self.boundary, window=self.window
        )

    def within(self, window: Window) -> Reparameterization:
        """Return maps with the same coefficients and nodes that cover a window."""
        return Reparameterization(
            self.n_coefficients, self.nodes, degree=self.degree, boundary=self.boundary, window=window
        )

    def identity(self) -> Floats:
        """Return the (*n_coefficients, d_par) coefficients of the identity."""
        return self._identity.copy()

    def _displacement(self, coefficients: Floats) -> Floats:
        return components_first(coefficients - self._identity)

    def evaluate(self, coefficients: Floats, out: Floats | None = None) -> Floats:
        """Return ``D_i(u_l)``: (n_S, *n_coefficients, d_par) coefficients to (n_S, n_P, d_par) parameters.

        Directions that are not periodic are clipped to [0, 1]; this removes rounding only, for feasible maps. The answer
        lies in the memory of ``out`` where given, (n_S, d_par, n_P).
        """
        n = len(coefficients)
        into = None if out is None else out.reshape(n, self.n_directions, *self.grid)
        values = apply_directions(self._basis, self._displacement(coefficients), into)
        values += self._at
        for axis, periodic in enumerate(self.periodic):
            if not periodic:
                np.clip(values[:, axis], 0.0, 1.0, out=values[:, axis])
        return components_last(values.reshape(n, self.n_directions, -1))

    def slopes(self, coefficients: Floats) -> tuple[Floats, ...]:
        """Return ``dD_i/du_k`` at the nodes, one (n_S, n_P, d_par) array per direction k."""
        displacement = self._displacement(coefficients)
        out = []
        for axis in range(self.n_directions):
            values = apply_directions(self._mixed(axis), displacement)
            values[:, axis] += self.window.extent[axis]
            out.append(components_last(values).reshape(len(coefficients), -1, self.n_directions))
        return tuple(out)

    def _mixed(self, axis: int) -> tuple[Floats, ...]:
        """Return the matrices that differentiate in direction ``axis``."""
        return tuple(self._slope[k] if k == axis else self._basis[k] for k in range(self.n_directions))

    def pull_back(self, gradient: Floats, slope_gradients: tuple[Floats, ...] = ()) -> Floats:
        """Return ``df/db`` from ``df/dD(u_l)`` and, where given, ``df/d(dD/du_k)``; the transpose of the evaluations.

        Parameters
        ----------
        gradient : (n_S, n_P, d_par)
        slope_gradients : tuple of (n_S, n_P, d_par), optional

        Returns
        -------
        (n_S, *n_coefficients, d_par)
        """
        total = self._transposed(self._basis, gradient)
        for axis, one in enumerate(slope_gradients):
            total = total + self._transposed(self._mixed(axis), one)
        return components_last(total)

    def _transposed(self, matrices: tuple[Floats, ...], gradient: Floats) -> Floats:
        field = components_first(gradient.reshape(len(gradient), *self.grid, self.n_directions))
        return apply_directions(tuple(m.T for m in matrices), field)

    def displacements(self, direction: Floats) -> Floats:
        """Return the derivative of :meth:`evaluate` along (n_S, *n_coefficients, d_par): (n_S, d_par, n_P), without clipping."""
        values = apply_directions(self._basis, components_first(direction))
        return np.asarray(values.reshape(len(direction), self.n_directions, -1))

    def displacements_transposed(self, gradient: Floats) -> Floats:
        """Return the transpose of :meth:`displacements`: (n_S, d_par, n_P) to (n_S, *n_coefficients, d_par)."""
        field = gradient.reshape(len(gradient), self.n_directions, *self.grid)
        return components_last(apply_directions(tuple(b.T for b in self._basis), field))

    def normal_blocks(self, metric: Floats) -> Floats:
        """Return ``Basis^T M Basis`` of many shapes, or pairs of shapes: the Gauss-Newton blocks in the free coefficients.

        Parameters
        ----------
        metric : (..., n_P, d_par, d_par) float64
            A matrix at every landmark; symmetric for one shape, ``S_i'^T S_j'`` for a pair.

        Returns
        -------
        (..., n, n) float64
            n free coefficients, in the order of ``free.ravel()``.
        """
        n_d = self.n_directions
        lead = metric.shape[:-3]
        if n_d == 1:
            basis = self._basis[0][:, self.free.ravel()]
            return np.asarray(basis.T @ (metric.reshape(*lead, -1, 1) * basis))
        left, right, places = self._overlaps
        size = int(np.count_nonzero(self.free))
        field = metric.reshape(-1, *self.grid, 2, 2)
        out = np.zeros((len(field), size * size))
        for (c, e), (target, kept) in places.items():
            block = left.T @ (np.ascontiguousarray(field[..., c, e]) @ right)
            out[:, target] = block.reshape(len(field), -1)[:, kept]
        return out.reshape(*lead, size, size)

    @cached_property
    def _overlaps(self) -> tuple[Floats, Floats, dict[tuple[int, int], tuple[Ints, Ints]]]:
        """Return, per direction, the products of the basis functions that overlap, (n, n_pairs).

        Then, for every two components, where in a block of the free coefficients their products go, and which ones do.
        """
        found = []
        for b in self._basis:
            first, second = np.nonzero((np.abs(b).T @ np.abs(b)) > 0)
            found.append((b[:, first] * b[:, second], first, second))
        (left, row0, column0), (right, row1, column1) = found
        a1, number = self.n_coefficients[1], numbered(self.free)
        rows, columns = (row0[:, None] * a1 + row1).ravel() * 2, (column0[:, None] * a1 + column1).ravel() * 2
        size = int(np.count_nonzero(self.free))
        places = {}
        for c, e in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row, column = number[rows + c], number[columns + e]
            kept = np.flatnonzero((row >= 0) & (column >= 0)).astype(np.int64)
            places[c, e] = row[kept] * size + column[kept], kept
        return left, right, places

    def rows_at(self, parameters: Floats) -> Floats:
        """Return the (n, prod(n_coefficients)) basis of one component of ``D`` at scattered (n, d_par) ``parameters``."""
        rows = self.directions[0].matrix(parameters[:, 0])
        if self.n_directions == 2:
            rows = np.einsum("na,nb->nab", rows, self.directions[1].matrix(parameters[:, 1])).reshape(len(rows), -1)
        return rows


def numbered(free: Bools) -> Ints:
    """Return the number of every coefficient among the free ones, -1 for the others, flat.

    Examples
    --------
    >>> numbered(np.array([False, True, True]))
    array([-1,  0,  1])
    """
    return np.where(free.ravel(), np.cumsum(free) - 1, -1).astype(np.int64)


def free_coefficients(n_coefficients: tuple[int, ...], boundary: Boundary, window: Window | None = None) -> Bools:
    """Return the (*n_coefficients, d_par) mask of unknowns for a boundary mode, and for the open edges of a window.

    Examples
    --------
    >>> [int(free_coefficients((8, 8), b).sum()) for b in ("fixed", "sliding", "periodic")]
    [72, 96, 112]
    >>> [int(free_coefficients((8,), b).sum()) for b in ("fixed", "periodic")]
    [6, 8]
    """
    free = np.ones((*n_coefficients, len(n_coefficients)), dtype=bool)
    if boundary != "periodic":
        free[[0, -1], ..., 0] = False
    if len(n_coefficients) == 2:
        free[:, [0, -1], 1] = False
        if boundary == "fixed":
            free[:, [0, -1], 0] = False
            free[[0, -1], :, 1] = False
        elif boundary == "sliding":
            free[[0, -1], [0, -1], :] = False
            free[[0, -1], [-1, 0], :] = False
    for axis, end in window.open_edges if window is not None else ():
        free[(slice(None),) * axis + (end,)] = True
    return free
