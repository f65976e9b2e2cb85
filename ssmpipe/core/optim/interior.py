"""Limited-memory quasi-Newton descent that never leaves an open feasible set.

The problem tells how far a direction may be followed; the line search starts inside that bound, so that infeasible points
are never evaluated and the quasi-Newton memory is never fed with the values of a wall.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.result import Result, Status


class InteriorProblem(Protocol):
    """A smooth function on an open set."""

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return the function value and the gradient at a feasible ``x``."""

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return the supremum of ``a`` for which the whole segment up to ``x + a direction`` is feasible."""

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return an approximation of the inverse Hessian at ``x``, symmetric positive definite."""


@dataclass(frozen=True)
class DescentOptions:
    """When to stop and how much to remember.

    Parameters
    ----------
    max_iterations : int
    relative_decrease : float
        Stop when the decrease over one iteration falls below this share of ``max(1, |f|)`` twice in a row.
    gradient_tolerance : float
        Stop when the preconditioned gradient norm ``sqrt(g' H g)`` falls below it.
    memory : int
        Pairs of the limited-memory update.
    refresh : int
        Iterations between two preconditioners.
    to_boundary : float
        Largest share of the feasible segment that one step may use.
    """

    max_iterations: int = 200
    relative_decrease: float = 1e-6
    gradient_tolerance: float = 1e-9
    memory: int = 20
    refresh: int = 10
    to_boundary: float = 0.9


def minimize_interior(
    problem: InteriorProblem,
    x0: Floats,
    options: DescentOptions | None = None,
    *,
    callback: Callable[[int, Floats, float, Floats], None] | None = None,
) -> Result[Floats]:
    """Minimize by preconditioned L-BFGS with a feasible backtracking line search (Nocedal and Wright 2006, ch. 7 and 19).

    Parameters
    ----------
    problem : InteriorProblem
    x0 : (n,) float64
        Strictly feasible.
    options : DescentOptions, optional
    callback : callable, optional
        ``callback(iteration, x, value, gradient)`` after every accepted step.

    Returns
    -------
    Result
        ``history["value"]`` starts with the value at ``x0``; it never increases.
    """
    opts = options or DescentOptions()
    x = x0.copy()
    value, gradient = problem.value_and_gradient(x)
    values = [value]
    pairs: deque[tuple[Floats, Floats, float]] = deque(maxlen=opts.memory)
    apply_inverse: Callable[[Floats], Floats] | None = None
    age = 0
    small = 0
    n_evaluations = 1
    status: Status = "out-of-iterations"
    iteration = 0
    while iteration < opts.max_iterations:
        if apply_inverse is None or age >= opts.refresh:
            apply_inverse = problem.preconditioner(x)
            age = 0
        direction = -_two_loop(gradient, pairs, apply_inverse)
        slope = float(gradient @ direction)
        if slope >= 0:
            pairs.clear()
            direction = -apply_inverse(gradient)
            slope = float(gradient @ direction)
        if -slope <= opts.gradient_tolerance**2:
            status = "converged"
            break
        step = min(1.0, opts.to_boundary * problem.largest_step(x, direction))
        accepted = False
        for _ in range(30):
            trial = x + step * direction
            trial_value, trial_gradient = problem.value_and_gradient(trial)
            n_evaluations += 1
            if trial_value <= value + 1e-4 * step * slope:
                accepted = True
                break
            curvature = trial_value - value - step * slope
            step *= float(np.clip(-0.5 * slope * step / curvature, 0.1, 0.5)) if curvature > 0 else 0.5
        if not accepted:
            if pairs or age > 0:
                pairs.clear()
                apply_inverse = None
                continue
            status = "stalled"
            break
        s = trial - x
        y = trial_gradient - gradient
        sy = float(s @ y)
        if sy > 1e-10 * float(np.linalg.norm(s) * np.linalg.norm(y)):
            pairs.append((s, y, sy))
        decrease = value - trial_value
        x, value, gradient = trial, trial_value, trial_gradient
        values.append(value)
        iteration += 1
        age += 1
        if callback is not None:
            callback(iteration, x, value, gradient)
        small = small + 1 if decrease < opts.relative_decrease * max(1.0, abs(value)) else 0
        if small >= 2:
            status = "converged"
            break
    return Result(x, status, iteration, n_evaluations, {"value": np.array(values)})


def _two_loop(
    gradient: Floats, pairs: deque[tuple[Floats, Floats, float]], apply_inverse: Callable[[Floats], Floats]
) -> Floats:
    """Return the quasi-Newton product ``H g`` (Nocedal and Wright 2006, algorithm 7.4)."""
    q = gradient.copy()
    factors = []
    for s, y, sy in reversed(pairs):
        a = float(s @ q) / sy
        factors.append(a)
        q -= a * y
    q = apply_inverse(q)
    for (s, y, sy), a in zip(pairs, reversed(factors), strict=True):
        q += (a - float(y @ q) / sy) * s
    return q
