"""The loop shared by the baselines: draw a warp, find its best magnitude, keep it if the description length falls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.correspondence.description_length import description_length
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.result import Result, Status
from ssmpipe.core.spline.evaluate import Spline, SplineStack


class Warp(Protocol):
    """A bijection of the unit interval or square onto itself that leaves the boundary in place."""

    def __call__(self, parameters: Floats) -> Floats:
        """Map (n, d_par) parameters."""


@dataclass(frozen=True, eq=False)
class Family:
    """One kind of warp: how it is drawn, whom it moves, and how its magnitude is searched.

    Parameters
    ----------
    n_directions : int
        Number of parameters: 1 for curves, 2 for surfaces.
    draw : callable
        ``draw(rng)`` returns what stays fixed while the magnitude is searched (centre, width, direction).
    support : callable
        ``support(drawn, parameters)`` returns the indices of the parameters that a warp moves.
    warp : callable
        ``warp(drawn, magnitude)`` returns the warp; magnitude 0 is the identity.
    search : callable
        ``search(f, drawn)`` looks for a low ``f(magnitude)``; the lowest one it met counts.
    """

    n_directions: int
    draw: Callable[[np.random.Generator], Floats]
    support: Callable[[Floats, Floats], Ints]
    warp: Callable[[Floats, Floats], Warp]
    search: Callable[[Callable[[Floats], float], Floats], object]


@dataclass(frozen=True, eq=False)
class Concatenation:
    """A correspondence made of many warps.

    Parameters
    ----------
    parameters : (n_S, n_P, d_par)
        ``D_i(u_l)``.
    points : (n_S, n_P, d)
        ``S_i(D_i(u_l))``.
    warps : tuple per shape of tuple of Warp
        ``D_i`` is the first one followed by the others.
    description_length : (before, after)
    """

    parameters: Floats
    points: Floats
    warps: tuple[tuple[Warp, ...], ...]
    description_length: tuple[float, float]

    def evaluate(self, shape: int, parameters: Floats) -> Floats:
        """Return ``D_i`` at any (n, d_par) parameters."""
        for warp in self.warps[shape]:
            parameters = warp(parameters)
        return parameters


class _Cohort:
    """Points of all shapes and their Gram matrix, updated when some landmarks of one shape move."""

    def __init__(self, splines: Sequence[Spline], parameters: Floats, lambda_cut: float) -> None:
        self._stacks = [SplineStack([s]) for s in splines]
        self._lambda_cut = lambda_cut
        self.parameters = np.repeat(parameters[None], len(splines), axis=0)
        points = SplineStack(splines).evaluate(self.parameters).points
        self.offset = points.mean(axis=0)  # small numbers lose nothing when the Gram matrix is centred
        self.points = points - self.offset
        flat = self.points.reshape(len(splines), -1)
        self._products = flat @ flat.T
        self.value = self._length(self._products)

    def _length(self, products: Floats) -> float:
        n_shapes, n_points = self.points.shape[:2]
        centred = products - products.mean(axis=0)
        centred -= centred.mean(axis=1)[:, None]
        eigenvalues = np.linalg.eigvalsh(centred)[1:] / ((n_shapes - 1) * n_points)
        return description_length(eigenvalues, self._lambda_cut)

    def _moved(self, shape: int, index: Ints, parameters: Floats) -> tuple[Floats, Floats]:
        points = self._stacks[shape].evaluate(parameters[None]).points[0] - self.offset[index]
        old = self.points[shape, index]
        row = self._products[shape] + self.points[:, index].reshape(len(self.points), -1) @ (points - old).ravel()
        row[shape] = self._products[shape, shape] + float((points**2).sum() - (old**2).sum())
        return points, row

    def trial(self, shape: int, index: Ints, parameters: Floats) -> float:
        """Return the description length with the indexed landmarks of one shape elsewhere."""
        row = self._moved(shape, index, parameters)[1]
        products = self._products.copy()
        products[shape] = products[:, shape] = row
        return self._length(products)

    def move(self, shape: int, index: Ints, parameters: Floats) -> bool:
        """Move landmarks if that lowers the description length, and say so.

        The changed row is computed anew: rounding neither accumulates nor decides.
        """
        points, products = self.points[shape].copy(), self._products.copy()
        self.points[shape, index] = self._moved(shape, index, parameters)[0]
        flat = self.points.reshape(len(self.points), -1)
        self._products[shape] = self._products[:, shape] = flat @ flat[shape]
        value = self._length(self._products)
        if not value < self.value:
            self.points[shape], self._products = points, products
            return False
        self.parameters[shape, index] = parameters
        self.value = value
        return True


def optimize_concatenation(
    splines: Sequence[Spline],
    family: Family,
    *,
    grid: tuple[int, ...],
    lambda_cut: float,
    reference: int,
    n_warps: int,
    rng: np.random.Generator,
    time_budget_s: float | None = None,
    max_evaluations: int | None = None,
    target: float | None = None,
    clock: Callable[[], float] | None = None,
) -> Result[Concatenation]:
    """Minimize the description length by concatenating random warps, one shape and one warp at a time.

    A warp whose best magnitude does not lower the description length is dropped, so the history never rises.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        At least two, of equal degree and knots.
    family : Family
        Kind of warp.
    grid : (int,) or (int, int)
        Landmarks per direction, evenly spaced, ends included, of equal weight.
    lambda_cut : float
        Threshold of the description length [mm^2].
    reference : int
        Shape that keeps the identity; -1 lets all move.
    n_warps : int
        Warps to try.
    rng : numpy.random.Generator
        Draws shapes and warps.
    time_budget_s : float, optional
        Stop after so many seconds of ``clock``.
    max_evaluations : int, optional
        Stop after so many evaluations of the description length.
    target : float, optional
        Stop at this description length; the status is then ``converged``.
    clock : callable, optional
        Returns seconds; needed for a time budget and for times in the history.

    Returns
    -------
    Result[Concatenation]
        ``history``: ``description_length``, ``evaluations``, ``accepted`` (0 or 1) and ``elapsed`` (not a number without a
        clock), one entry per warp, the start first.

    Raises
    ------
    GeometryError
        If there is one shape only, the grid does not fit the splines, or a time budget comes without a clock.
    """
    if len(splines) < 2:
        raise GeometryError(f"correspondence needs at least two shapes, got {len(splines)}")
    n_directions = len(splines[0].degrees)
    if n_directions != family.n_directions or len(grid) != family.n_directions:
        raise GeometryError(
            f"these warps have {family.n_directions} parameters, the shapes {n_directions}, the grid {len(grid)}"
        )
    if time_budget_s is not None and clock is None:
        raise GeometryError("a time budget needs a clock", "pass clock=time.perf_counter")
    moving = np.array([i for i in range(len(splines)) if i != reference])
    nodes = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in grid), indexing="ij")
    begin = clock() if clock is not None else float("nan")
    cohort = _Cohort(splines, np.stack([n.ravel() for n in nodes], axis=-1), lambda_cut)
    before = cohort.value
    kept: list[list[Warp]] = [[] for _ in splines]
    rows = [(before, 0.0, 0.0, 0.0 if clock is not None else float("nan"))]
    evaluations = 0
    status: Status = "out-of-iterations"
    while len(rows) <= n_warps:
        if target is not None and cohort.value <= target:
            status = "converged"
            break
        if time_budget_s is not None and rows[-1][3] >= time_budget_s:
            break
        if max_evaluations is not None and evaluations >= max_evaluations:
            break
        shape = int(moving[rng.integers(len(moving))])
        drawn = family.draw(rng)
        trial = _Trial(cohort, family, shape, drawn)
        accepted = False
        if len(trial.index):
            family.search(trial, drawn)
            evaluations += trial.evaluations
            warp = family.warp(drawn, trial.best)
            accepted = cohort.move(shape, trial.index, warp(trial.start))
            if accepted:
                kept[shape].append(warp)
        now = clock() - begin if clock is not None else float("nan")
        rows.append((cohort.value, float(evaluations), float(accepted), now))
    if target is not None and cohort.value <= target:
        status = "converged"
    concatenation = Concatenation(
        cohort.parameters, cohort.points + cohort.offset, tuple(tuple(w) for w in kept), (before, cohort.value)
    )
    columns = np.array(rows).T
    names = ("description_length", "evaluations", "accepted", "elapsed")
    return Result(
        concatenation, status, len(rows) - 1, evaluations, dict(zip(names, (c.copy() for c in columns), strict=True))
    )


class _Trial:
    """The description length as a function of one warp's magnitude; remembers where it was lowest."""

    def __init__(self, cohort: _Cohort, family: Family, shape: int, drawn: Floats) -> None:
        self._cohort, self._family, self._shape, self._drawn = cohort, family, shape, drawn
        self.index = family.support(drawn, cohort.parameters[shape])
        self.start = cohort.parameters[shape, self.index]
        self.lowest = np.inf
        self.best = np.zeros(family.n_directions)
        self.evaluations = 0

    def __call__(self, magnitude: Floats) -> float:
        self.evaluations += 1
        warp = self._family.warp(self._drawn, magnitude)
        value = self._cohort.trial(self._shape, self.index, warp(self.start))
        if value < self.lowest:
            self.lowest, self.best = value, np.array(magnitude)
        return value
