"""Rims that are cuts and no anatomy: the part of the reference that all shapes have, and maps of it to begin with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.affine_start import DensePoints, MapFit, turned_identity
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.spline.evaluate import SplineStack

CROP_STEP = 0.005
"""By how much an edge moves at a time [share of the parameter]."""
ROOM = 0.01
"""Least distance of a carried edge from the edge of a shape [share of the parameter]."""


@dataclass(frozen=True, eq=False)
class Registered:
    """The reference registered to all shapes with rims that may lie anywhere, past the rims of a shape too.

    Parameters
    ----------
    space : Reparameterization
        Without a window.
    displacement : (n_S, *n_coefficients, 2)
        Of the maps from the turned identity; zero for the reference, and for a shape that does not fit.
    turns : (n_S,)
    element : (n_P,)
        Area that every landmark stands for on the reference, up to a factor.
    """

    space: Reparameterization
    displacement: Floats
    turns: Floats
    element: Floats

    def carried(self, u: Floats) -> Floats:
        """Return where (n, 2) places of the reference lie on every shape, (n_S, n, 2), without the turns."""
        flat = self.displacement.reshape(len(self.displacement), -1, 2)
        return np.asarray(u + self.space.rows_at(u) @ flat)

    def rim_shifts(self, open_edges: Sequence[tuple[int, int]]) -> Floats:
        """Return by how much the rims of every shape lie elsewhere than those of the reference, (n_S,) [share of the parameter].

        The mean shift across each edge, without its sign, mean over the edges.
        """
        shifts = [np.take(self.displacement[..., axis], end, axis=1 + axis).mean(axis=1) for axis, end in open_edges]
        return np.asarray(np.abs(shifts).mean(axis=0))

    def window(self, open_edges: Sequence[tuple[int, int]], max_crop: float) -> Window:
        """Return the box that all shapes have: edges move inward, together, until every shape has what is left.

        Parameters
        ----------
        open_edges : sequence of (direction, end)
            Edges that move, end 0 or -1.
        max_crop : float
            Farthest an edge moves [share of the parameter]. A shape that lacks more is not waited for.
        """
        low, high = np.zeros(2), np.ones(2)
        for _ in range(round(max_crop / CROP_STEP)):
            short = self._short(open_edges, low, high)
            for axis, end in (e for e, lacking in short.items() if lacking.any()):
                (low if end == 0 else high)[axis] += CROP_STEP if end == 0 else -CROP_STEP
            if not any(lacking.any() for lacking in short.values()):
                break
        for axis, end in open_edges:  # an edge that may move needs room even where no shape lacks anything
            low[axis] = max(low[axis], ROOM) if end == 0 else low[axis]
            high[axis] = min(high[axis], 1.0 - ROOM) if end == -1 else high[axis]
        return Window(tuple(low.round(6).tolist()), tuple(high.round(6).tolist()))

    def lacking(self, window: Window) -> tuple[int, ...]:
        """Return the shapes that do not have all of a window."""
        short = self._short(window.open_edges, np.array(window.low), np.array(window.high))
        return tuple(int(i) for i in np.flatnonzero(np.any(list(short.values()), axis=0)))

    def _short(self, open_edges: Sequence[tuple[int, int]], low: Floats, high: Floats) -> dict[tuple[int, int], Floats]:
        """Return which shapes end before an edge of the box, (n_S,) for every edge."""
        found = {}
        for axis, end in open_edges:
            edge = np.linspace(low, high, 41)
            edge[:, axis] = low[axis] if end == 0 else high[axis]
            at = self.carried(edge)[..., axis]
            found[axis, end] = at.min(axis=1) < 0.999 * ROOM if end == 0 else at.max(axis=1) > 1.0 - 0.999 * ROOM
        return found

    def within(self, window: Window) -> Floats:
        """Return the maps of a window, (n_S, *n_coefficients, 2); they may fold, and leave a shape that lacks a part of it."""
        space = self.space.within(window)
        fit = MapFit(space)
        targets = self.carried(fit.own)
        targets[..., 0] += self.turns[:, None]
        return np.stack([fit.maps(t, self.element, float(a)) for t, a in zip(targets, self.turns, strict=True)])


def register_reference(
    stack: SplineStack,
    space: Reparameterization,
    reference: int,
    open_edges: Sequence[tuple[int, int]],
    *,
    turns: Floats,
    n_dense: int = 101,
    n_rounds: int = 12,
) -> Registered:
    """Register the reference to every shape, by a similarity from the pose they have and then by an affine map.

    Places of the reference that lie beyond a rim of the other shape are carried past it along the tangent.

    Parameters
    ----------
    stack : SplineStack
        Surfaces in three dimensions, roughly posed.
    space : Reparameterization
        With the landmarks as nodes, without a window.
    reference : int
    open_edges : sequence of (direction, end)
        The rims: edges that are neither a seam nor a pole, end 0 or -1.
    turns : (n_S,) float64
        By how much the first parameter of every shape is turned before; zero for the reference.
    n_dense, n_rounds : int
        As in :func:`.affine_start.affine_start`.

    Returns
    -------
    Registered
    """
    own = space.evaluate(space.identity()[None])
    nodes = stack.evaluate(np.repeat(own, stack.n_shapes, axis=0))
    fixed = np.array(nodes.points[reference])
    area = np.cross(nodes.first[0][reference], nodes.first[1][reference])
    identity = turned_identity(space, turns)
    dense, fit = DensePoints(stack, space, n_dense), MapFit(space, open_edges)
    displacement = np.zeros_like(identity)
    for i in (i for i in range(stack.n_shapes) if i != reference):
        found = dense.registered(i, fixed, area, None, n_rounds, open_edges)
        if found is not None:
            displacement[i] = fit.maps(*found, float(turns[i])) - identity[i]
    return Registered(space, displacement, turns, np.linalg.norm(area, axis=1))
