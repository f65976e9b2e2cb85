"""Sums over the landmarks of all shapes, in blocks of landmark rows that any process can take over.

The Gram matrix of the landmarks and the derivative in the coefficients are sums over landmarks. A block of rows of the landmark grid
contributes to both from the coefficients alone, given the splines: only free coefficients, one (n_S, n_S) matrix and the product that
it is differentiated with have to travel, not landmarks. Number and order of the blocks are fixed, so the sums have the same bits
wherever the blocks are evaluated.
"""

from __future__ import annotations

import copy
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.blocks import map_blocks
from ssmpipe.core.correspondence.covariance import centred_spectrum, parameter_adjoint
from ssmpipe.core.correspondence.reparameterization import Boundary, Reparameterization
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.engine import Arrays, Content, Engine
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Jet, Spline, SplineStack, shapes_per_block
from ssmpipe.core.spline.surface import BSplineSurface

MANY_SHAPES = 64
"""From so many shapes on the rows are parted by default; below, an iteration takes less time than it takes to ask others."""
DEFAULT_BLOCKS = 4
_REMEMBERED = 2
Rows = tuple[int, int]
SlopeProduct = Callable[[Floats], Floats]


def automatic_blocks(n_shapes: int) -> int:
    """Return the number of blocks for ``landmark_blocks: auto``; it depends on the cohort only.

    Examples
    --------
    >>> automatic_blocks(12), automatic_blocks(200)
    (1, 4)
    """
    return DEFAULT_BLOCKS if n_shapes >= MANY_SHAPES else 1


class LandmarkRows:
    """Some rows of the landmark grid, for all shapes.

    Parameters
    ----------
    stack : SplineStack
    space : Reparameterization
        Its nodes are the landmarks of these rows.
    weights : (n,) float64
        Of these landmarks.
    """

    def __init__(self, stack: SplineStack, space: Reparameterization, weights: Floats) -> None:
        self.free = space.free
        self._stack = copy.copy(stack)  # work memory of its own
        self._stack.threads = 1  # blocks are what threads share
        self._space = space
        self._weights = weights
        shape = (stack.n_shapes, space.n_directions, math.prod(space.grid))
        self._parameters, self._d_parameters = np.empty(shape), np.empty(shape)
        self._shapes_at_once = shapes_per_block(shape[2])
        self._jet: Jet | None = None
        self._centred: Floats | None = None
        self._at = b""

    def gram(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n_S) share of these landmarks in the Gram matrix, for (n_S, *n_b, d_par) coefficients."""
        self._at = b""
        stack = self._stack
        jet = stack.room(self._parameters.shape[2], reuse=self._jet)

        def some(block: slice) -> None:
            stack.evaluate_some(block, self._space.evaluate(coefficients[block], self._parameters[block]), jet)

        map_blocks(some, stack.n_shapes, self._shapes_at_once)
        self._centred, spectrum = centred_spectrum(
            jet.points, self._weights, evaluator=stack.evaluator, out=self._centred
        )
        self._jet, self._at = jet, coefficients.tobytes()
        return spectrum.gram

    def pull_back(self, coefficients: Floats, slope_product: SlopeProduct) -> Floats:
        """Return the (n_S, *n_b, d_par) share of these landmarks in the derivative of a function of the Gram matrix."""
        if self._at != coefficients.tobytes():
            self.gram(coefficients)
        assert self._jet is not None
        assert self._centred is not None
        stack, out = self._stack, self._d_parameters
        parameter_adjoint(
            self._centred,
            self._weights,
            slope_product,
            self._jet.first,
            out,
            evaluator=stack.evaluator,
        )
        return self._space.displacements_transposed(out)


class RowSums:
    """All blocks of rows, here or in the processes of an engine.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        As the objective sees them.
    stack : SplineStack
        The same splines.
    space : Reparameterization
        Its nodes are the landmarks.
    weights : (n_P,) float64
    n_blocks : int
        At most one per row. The last digits of the sums depend on it, on nothing else.
    engine : Engine, optional
        Without one the blocks are evaluated here, one after the other.
    """

    def __init__(
        self,
        splines: Sequence[Spline],
        stack: SplineStack,
        space: Reparameterization,
        weights: Floats,
        n_blocks: int,
        engine: Engine | None = None,
    ) -> None:
        n_rows = space.grid[0]
        n_blocks = min(n_blocks, n_rows)
        self._rows = [(n_rows * k // n_blocks, n_rows * (k + 1) // n_blocks) for k in range(n_blocks)]
        self._splines, self._stack, self._space, self._weights = splines, stack, space, weights
        self._engine = engine if engine is not None and min(engine.n_workers, n_blocks) > 1 else None
        self._blocks: list[LandmarkRows] | None = None
        self._content: Content | None = None

    def gram(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n_S) Gram matrix for (n_S, *n_b, d_par) coefficients."""
        if self._engine is None:
            return _total(self._shared(lambda block: block.gram(coefficients)))
        n = len(coefficients)
        lower = np.tril_indices(n)
        packed = self._there(self._engine, grams, (coefficients[:, self._space.free],))
        out = np.zeros((n, n))
        for one in packed:
            out[lower] += one
        out.T[lower] = out[lower]
        return out

    def pull_back(self, coefficients: Floats, slope_product: SlopeProduct) -> Floats:
        """Return the derivative in the free coefficients of a function of the Gram matrix; see :meth:`Spectrum.slope_product`."""
        if self._engine is None:
            return _total(self._shared(lambda block: block.pull_back(coefficients, slope_product)))
        out = np.zeros_like(coefficients)
        free = self._space.free
        out[:, free] = _total(self._there(self._engine, pull_backs, (coefficients[:, free], slope_product)))
        return out

    def _shared(self, function: Callable[[LandmarkRows], Floats]) -> list[Floats]:
        blocks = self._here()
        return map_blocks(lambda one: function(blocks[one.start]), len(blocks), 1, self._stack.threads)

    def _here(self) -> list[LandmarkRows]:
        if self._blocks is None:
            self._blocks = [_block(self._stack, self._space, self._weights, rows) for rows in self._rows]
        return self._blocks

    def _there(self, engine: Engine, function: Callable[..., list[Floats]], what: tuple[object, ...]) -> list[Floats]:
        if self._content is None:
            self._content = engine.share(_described(self._splines, self._stack, self._space, self._weights))
        n, m = len(self._rows), min(engine.n_workers, len(self._rows))
        shares = [tuple(self._rows[n * k // m : n * (k + 1) // m]) for k in range(m)]
        answers = engine.call(function, [(self._content, share, *what) for share in shares])
        return [one for answer in answers for one in answer]


def grams(content: Content, rows: tuple[Rows, ...], unknowns: Floats) -> list[Floats]:
    """Return the lower triangles of the shares of some blocks, for (n_S, n_free) unknowns; called in a process of an engine."""
    lower = np.tril_indices(len(unknowns))
    with _ONE_CALL:
        coefficients, blocks = _found(content, rows, unknowns)
        return [block.gram(coefficients)[lower] for block in blocks]


def pull_backs(content: Content, rows: tuple[Rows, ...], unknowns: Floats, slope_product: SlopeProduct) -> list[Floats]:
    """Return the (n_S, n_free) shares of some blocks in the derivative; called in a process of an engine."""
    with _ONE_CALL:
        coefficients, blocks = _found(content, rows, unknowns)
        return [block.pull_back(coefficients, slope_product)[:, block.free] for block in blocks]


def _total(parts: list[Floats]) -> Floats:
    out = np.zeros_like(parts[0])
    for part in parts:
        out += part
    return out


def _block(stack: SplineStack, space: Reparameterization, weights: Floats, rows: Rows) -> LandmarkRows:
    some = slice(*rows)
    return LandmarkRows(
        stack,
        space.at((space.nodes[0][some], *space.nodes[1:])),
        weights.reshape(space.grid)[some].ravel(),
    )


# --- in the processes of an engine ---------------------------------------------------------------------------------


class _Known:
    """What a process knows of one content."""

    def __init__(self, content: Content) -> None:
        self.stack, self.space, self.weights = _understood(content.load())
        self.blocks: dict[Rows, LandmarkRows] = {}


_KNOWN: OrderedDict[str, _Known] = OrderedDict()
_ONE_CALL = threading.Lock()
"""Blocks have work memory: a call that was given up may still be running when it is made again in the same process."""


def _found(content: Content, rows: tuple[Rows, ...], unknowns: Floats) -> tuple[Floats, list[LandmarkRows]]:
    """Return the coefficients, and blocks from the memory of this process, made from the content on a miss."""
    known = _KNOWN.get(content.key)
    if known is None:
        known = _KNOWN[content.key] = _Known(content)
        while len(_KNOWN) > _REMEMBERED:
            _KNOWN.popitem(last=False)
    _KNOWN.move_to_end(content.key)
    for one in rows:
        if one not in known.blocks:
            known.blocks[one] = _block(known.stack, known.space, known.weights, one)
    coefficients = np.repeat(known.space.identity()[None], len(unknowns), axis=0)
    coefficients[:, known.space.free] = unknowns
    return coefficients, [known.blocks[one] for one in rows]


def _described(splines: Sequence[Spline], stack: SplineStack, space: Reparameterization, weights: Floats) -> Arrays:
    out = {
        "control": np.stack([s.control_points for s in splines]),
        "degrees": np.array(splines[0].degrees),
        "periodic": np.array(stack.periodic),
        "n_coefficients": np.array(space.n_coefficients),
        "degree": np.array(space.degree),
        "boundary": np.array(space.boundary),
        "window": np.array([space.window.low, space.window.high]),
        "weights": weights,
    }
    out |= {f"knots_{k}": knots for k, knots in enumerate(splines[0].knot_vectors)}
    return out | {f"nodes_{k}": nodes for k, nodes in enumerate(space.nodes)}


def _understood(arrays: Arrays) -> tuple[SplineStack, Reparameterization, Floats]:
    degrees = [int(p) for p in arrays["degrees"]]
    n = len(degrees)
    knots = [arrays[f"knots_{k}"] for k in range(n)]
    splines: list[Spline]
    if n == 1:
        splines = [BSplineCurve(degrees[0], knots[0], c) for c in arrays["control"]]
    else:
        splines = [BSplineSurface((degrees[0], degrees[1]), knots[0], knots[1], c) for c in arrays["control"]]
    boundary: Boundary = str(arrays["boundary"])  # type: ignore[assignment]
    space = Reparameterization(
        tuple(int(k) for k in arrays["n_coefficients"]),
        tuple(arrays[f"nodes_{k}"] for k in range(n)),
        degree=int(arrays["degree"]),
        boundary=boundary,
        window=Window(*(tuple(row.tolist()) for row in arrays["window"])),
    )
    return SplineStack(splines, tuple(bool(p) for p in arrays["periodic"])), space, arrays["weights"]
