"""Many splines evaluated at their own scattered points: position and derivatives in one pass.

The splines are converted once to local polynomials, one coefficient block per knot-span cell, so that a point costs one
gather of ``(p+1)^d_par d`` numbers and a Horner scheme that yields the value and the derivatives together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.blocks import map_blocks
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline import compiled
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import breakpoints
from ssmpipe.core.spline.surface import BSplineSurface

Spline: TypeAlias = BSplineCurve | BSplineSurface
Evaluator = Literal["auto", "numpy", "numba"]
_POINTS_PER_BLOCK = 45_000
"""Of all shapes of a block: a few milliseconds. Threads hand the interpreter lock over at every call of numpy, which costs as much as
a small block."""


def shapes_per_block(n_points: int) -> int:
    """Return how many shapes with ``n_points`` points each are worked on at once.

    Examples
    --------
    >>> shapes_per_block(51 * 51), shapes_per_block(201 * 201)
    (17, 1)
    """
    return max(1, _POINTS_PER_BLOCK // n_points)


def check_comparable(splines: Sequence[Spline]) -> None:
    """Check that splines agree in kind, degree and dimension.

    Raises
    ------
    GeometryError
        With the number of the first that differs.
    """
    first = splines[0]
    for k, other in enumerate(splines):
        if other.degrees != first.degrees or other.dimension != first.dimension:
            raise GeometryError(
                f"spline {k} has degrees {other.degrees} and dimension {other.dimension}, "
                f"spline 0 has {first.degrees} and {first.dimension}",
                "fit all shapes with the same degree",
            )


@dataclass(frozen=True, eq=False)
class Jet:
    """Positions and derivatives of ``n_S`` splines, each at its own ``n_P`` points.

    Parameters
    ----------
    points : (n_S, n_P, d)
    first : (d_par arrays of) (n_S, n_P, d)
        ``S_u`` and, for surfaces, ``S_v``.
    second : (arrays of) (n_S, n_P, d)
        ``S_uu`` for curves; ``S_uu, S_uv, S_vv`` for surfaces; empty unless asked for.
    """

    points: Floats
    first: tuple[Floats, ...]
    second: tuple[Floats, ...] = ()


def _span_polynomials(knots: Floats, degree: int) -> Floats:
    """Return (n_spans, degree + 1, n_control): monomial coefficients, in the local t in [0, 1], of the basis functions."""
    ends = breakpoints(knots)
    # the outermost nodes stay inside the span, so that each belongs to it without doubt
    t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    nodes = ends[:-1, None] + np.diff(ends)[:, None] * t
    values = design_matrix(nodes.ravel(), knots, degree).reshape(len(ends) - 1, degree + 1, -1)
    vandermonde = np.vander(t, increasing=True)
    shape = (len(ends) - 1, degree + 1, degree + 1)
    return np.asarray(np.linalg.solve(np.broadcast_to(vandermonde, shape), values), float)


def _horner(block: Floats, t: Floats, order: int) -> list[Floats]:
    """Evaluate polynomials along axis 1 of (n, degree + 1, m) at (n, 1) ``t``: value and ``order`` derivatives in t."""
    degree = block.shape[1] - 1
    out = [block[:, degree].copy()] + [np.zeros_like(block[:, 0]) for _ in range(order)]
    for k in range(degree - 1, -1, -1):
        for r in range(order, 0, -1):
            out[r] *= t
            out[r] += out[r - 1] if r == 1 else r * out[r - 1]
        out[0] *= t
        out[0] += block[:, k]
    return out


class SplineStack:
    """Splines that share degree and knots, ready for repeated evaluation.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        ``n_S`` splines of equal kind, degree, knots and dimension d.
    periodic : tuple of bool, optional
        Directions in which parameters are taken modulo 1.
    evaluator : {"auto", "numpy", "numba"}, default="auto"
        ``auto``: numba where it is installed (extra ``fast``). Both give the same bits.
    threads : int, default=1
        Threads that share the shapes; any number gives the same bits.

    Attributes
    ----------
    evaluator : {"numpy", "numba"}
        Which one runs.

    Raises
    ------
    GeometryError
        If the splines differ in degree, knots or dimension.

    Examples
    --------
    >>> flat = BSplineSurface((1, 1), np.array([0, 0, 1, 1.]), np.array([0, 0, 1, 1.]),
    ...                       np.array([[[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0.]]]))
    >>> SplineStack([flat]).evaluate(np.array([[[0.25, 0.5]]])).points
    array([[[0.25, 0.5 , 0.  ]]])
    """

    def __init__(
        self,
        splines: Sequence[Spline],
        periodic: tuple[bool, ...] | None = None,
        *,
        evaluator: Evaluator = "auto",
        threads: int = 1,
    ) -> None:
        check_comparable(splines)
        first = splines[0]
        for k, other in enumerate(splines):
            if not all(np.array_equal(a, b) for a, b in zip(other.knot_vectors, first.knot_vectors, strict=True)):
                raise GeometryError(
                    f"spline {k} has other knots than spline 0", "fit all shapes with the same control points"
                )
        self.n_shapes = len(splines)
        self.dimension = first.dimension
        self.degrees: tuple[int, ...] = first.degrees
        self.n_directions = len(first.degrees)
        self.periodic = periodic or (False,) * self.n_directions
        self._ends = tuple(breakpoints(k) for k in first.knot_vectors)
        self._uniform = tuple(bool(np.allclose(np.diff(e), e[1] - e[0], rtol=1e-12, atol=0)) for e in self._ends)
        polynomials = [_span_polynomials(k, p) for k, p in zip(first.knot_vectors, first.degrees, strict=True)]
        self._blocks = np.stack([self._cells(s.control_points, polynomials) for s in splines])
        if evaluator == "auto":
            evaluator = "numba" if compiled.available() else "numpy"
        self.evaluator = evaluator
        self._places: tuple[Ints, Floats] = np.empty(0, np.int64), np.empty(0)
        self.threads = threads

    @staticmethod
    def _cells(control: Floats, polynomials: list[Floats]) -> Floats:
        """Return (n_cells, coefficients) local polynomials of one spline."""
        if len(polynomials) == 1:
            local = np.einsum("sak,kd->sad", polynomials[0], control, optimize=True)
            return np.ascontiguousarray(local.reshape(len(local), -1))
        inner = np.einsum("sak,kld->sald", polynomials[0], control, optimize=True)
        local = np.einsum("tbl,sald->stabd", polynomials[1], inner, optimize=True)
        return np.ascontiguousarray(local.reshape(local.shape[0] * local.shape[1], -1))

    def _locate(self, axis: int, parameters: Floats) -> tuple[Ints, Floats, Floats]:
        """Return span index, local coordinate t in [0, 1] (n, 1) and 1 / span length (broadcastable to (n, 1))."""
        if self.periodic[axis]:
            parameters = parameters - np.floor(parameters)
        ends = self._ends[axis]
        n_spans = len(ends) - 1
        if self._uniform[axis]:
            scaled = parameters * n_spans
            index = np.clip(scaled.astype(np.int64), 0, n_spans - 1)
            return index, (scaled - index)[:, None], np.array(float(n_spans))
        index = np.clip(np.searchsorted(ends, parameters, side="right") - 1, 0, n_spans - 1).astype(np.int64)
        inverse = 1.0 / np.diff(ends)[index]
        return index, ((parameters - ends[index]) * inverse)[:, None], inverse[:, None]

    def evaluate(self, parameters: Floats, *, second: bool = False, reuse: Jet | None = None) -> Jet:
        """Return positions, first and (if asked for) second derivatives of all splines, each at its own points.

        Parameters
        ----------
        parameters : (n_S, n_P, d_par) float64
            In the unit interval or square; periodic directions take any number.
        second : bool, default=False
        reuse : Jet, optional
            A former answer whose memory may be overwritten; fresh memory costs as much time as the evaluation.
        """
        jet = self.room(parameters.shape[1], second=second, reuse=reuse)
        map_blocks(
            lambda block: self.evaluate_some(block, parameters[block], jet),
            self.n_shapes,
            shapes_per_block(parameters.shape[1]),
            self.threads,
        )
        return jet

    def room(self, n_points: int, *, second: bool = False, reuse: Jet | None = None) -> Jet:
        """Return memory for :meth:`evaluate_some`, that of ``reuse`` if it fits."""
        n_d = self.n_directions
        count = 1 + n_d + (n_d * (n_d + 1) // 2 if second else 0)
        shape = (self.n_shapes, n_points, self.dimension)
        out = [] if reuse is None else [reuse.points, *reuse.first, *reuse.second]
        if len(out) != count or out[0].shape != shape:
            out = [np.empty(shape) for _ in range(count)]
        n_places = (n_d, *shape[:2])
        if self.evaluator == "numba" and self._places[0].shape != n_places:
            self._places = np.empty(n_places, np.int64), np.empty(n_places)
        return Jet(out[0], tuple(out[1 : 1 + n_d]), tuple(out[1 + n_d :]))

    def evaluate_some(self, block: slice, parameters: Floats, jet: Jet) -> None:
        """Evaluate the splines of ``block`` at (n, n_P, d_par) parameters, into the memory of ``jet``, from :meth:`room`."""
        out, second = [jet.points, *jet.first, *jet.second], bool(jet.second)
        if self.evaluator == "numba":
            self._evaluate_compiled(block, parameters, out, second)
            return
        for i, own in zip(range(block.start, block.stop), parameters, strict=True):
            for target, values in zip(out, self._evaluate_one(i, own, second), strict=True):
                target[i] = values

    def _locate_compiled(self, axis: int, block: slice, parameters: Floats) -> tuple[Ints, Floats, Floats]:
        """Return span index, local coordinate and 1 / span length, (n, n_P) each; in equal spans without new memory."""
        if not self._uniform[axis]:
            index, local, inverse = self._locate(axis, parameters.ravel())
            shape = parameters.shape
            return index.reshape(shape), local.reshape(shape), np.broadcast_to(inverse.reshape(shape), shape)
        n_spans = len(self._ends[axis]) - 1
        index, local = self._places[0][axis, block], self._places[1][axis, block]
        compiled.locator()(parameters, n_spans, self.periodic[axis], index, local)
        return index, local, np.broadcast_to(np.array(float(n_spans)), parameters.shape)

    def _evaluate_compiled(self, block: slice, parameters: Floats, out: list[Floats], second: bool) -> None:
        shape = (*self._blocks.shape[:2], *(p + 1 for p in self.degrees), self.dimension)
        where = [self._locate_compiled(axis, block, parameters[..., axis]) for axis in range(self.n_directions)]
        cells = (len(self._ends[1]) - 1,) if self.n_directions == 2 else ()
        run = compiled.kernel(self.n_directions, second)
        run(self._blocks.reshape(shape)[block], *cells, *(a for w in where for a in w), *(o[block] for o in out))

    def _evaluate_one(self, i: int, parameters: Floats, second: bool) -> list[Floats]:
        order = 2 if second else 1
        index_u, t, du = self._locate(0, parameters[:, 0])
        p = self.degrees[0]
        if self.n_directions == 1:
            block = self._blocks[i][index_u].reshape(-1, p + 1, self.dimension)
            values = _horner(block, t, order)
            return [values[0], values[1] * du] + ([values[2] * du**2] if second else [])
        index_v, s, dv = self._locate(1, parameters[:, 1])
        q = self.degrees[1]
        cell = index_u * (len(self._ends[1]) - 1) + index_v
        block = self._blocks[i][cell].reshape(-1, p + 1, (q + 1) * self.dimension)
        rows = [r.reshape(-1, q + 1, self.dimension) for r in _horner(block, t, order)]
        value = _horner(rows[0], s, order)
        slope = _horner(rows[1], s, 1 if second else 0)
        out = [value[0], slope[0] * du, value[1] * dv]
        if second:
            out += [_horner(rows[2], s, 0)[0] * du**2, slope[1] * (du * dv), value[2] * dv**2]
        return out
