"""Descent that never leaves an open feasible set: truncated Newton, or limited-memory quasi-Newton.

The problem tells how far a direction may be followed; the line search starts inside that bound, so that infeasible points
are never evaluated and the quasi-Newton memory is never fed with the values of a wall.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.optim.state import DescentState
from ssmpipe.core.result import Result, Status


class InteriorProblem(Protocol):
    """A smooth function on an open set."""

    def value(self, x: Floats) -> float:
        """Return the function value at a feasible ``x``; steps that are not accepted need no more."""

    def value_and_gradient(self, x: Floats) -> tuple[float, Floats]:
        """Return the function value and the gradient at a feasible ``x``."""

    def largest_step(self, x: Floats, direction: Floats) -> float:
        """Return the supremum of ``a`` for which the whole segment up to ``x + a direction`` is feasible."""

    def preconditioner(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return an approximation of the inverse Hessian at ``x``, symmetric positive definite."""

    def step_taken(self, x: Floats, direction: Floats) -> None:
        """Hear that a step from ``x`` along ``direction`` was accepted, as a rule a part of it."""


@runtime_checkable
class CurvedProblem(InteriorProblem, Protocol):
    """A function whose second derivative can be multiplied with a vector."""

    def hessian(self, x: Floats) -> Callable[[Floats], Floats]:
        """Return the product of the second derivative at ``x`` with a vector; it may be indefinite."""


@runtime_checkable
class RememberingProblem(InteriorProblem, Protocol):
    """A function whose preconditioner or second derivative depends on more than ``x``: on the steps before, say."""

    def memory(self) -> Floats | None:
        """Return what is remembered; the array is not changed afterwards."""

    def recall(self, memory: Floats | None) -> None:
        """Remember that instead."""


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
    method : {"quasi-newton", "newton"}
        ``newton`` needs a :class:`CurvedProblem`; the memory is not used.
    newton_refresh : int
        Newton steps between two preconditioners.
    inner_iterations : int
        Largest number of products with the second derivative per Newton step.
    """

    max_iterations: int = 200
    relative_decrease: float = 1e-6
    gradient_tolerance: float = 1e-9
    memory: int = 20
    refresh: int = 10
    to_boundary: float = 0.9
    method: Literal["quasi-newton", "newton"] = "quasi-newton"
    newton_refresh: int = 3
    inner_iterations: int = 100


def minimize_interior(
    problem: InteriorProblem | CurvedProblem,
    x0: Floats,
    options: DescentOptions | None = None,
    *,
    callback: Callable[[int, Floats, float, Floats], None] | None = None,
    resume: DescentState | None = None,
    checkpoint: Callable[[DescentState], None] | None = None,
) -> Result[Floats]:
    """Minimize with a feasible backtracking line search (Nocedal and Wright 2006, ch. 7 and 19).

    Directions come from preconditioned L-BFGS, or from Newton's equation solved by preconditioned conjugate gradients only as
    far as it pays and only as far as the curvature is positive.

    Parameters
    ----------
    problem : InteriorProblem
    x0 : (n,) float64
        Strictly feasible.
    options : DescentOptions, optional
    callback : callable, optional
        ``callback(iteration, x, value, gradient)`` after every accepted step.
    resume : DescentState, optional
        Continue from there, to the same bits as without a break; ``x0`` is not looked at.
    checkpoint : callable, optional
        Gets the state after every accepted step but the last.

    Returns
    -------
    Result
        ``history["value"]`` starts with the value at ``x0``; it never increases.
    """
    opts = options or DescentOptions()
    pairs: deque[tuple[Floats, Floats, float]] = deque(maxlen=opts.memory)
    apply_inverse: Callable[[Floats], Floats] | None = None
    built_at, built_with = x0, _memory(problem)
    if resume is None:
        x = x0.copy()
        value, gradient = problem.value_and_gradient(x)
        values = [value]
        age, small, n_evaluations = 0, 0, 1
    else:
        x, gradient, values = resume.x, resume.gradient, list(resume.values)
        value, age, small, n_evaluations = values[-1], resume.age, resume.small, resume.n_evaluations
        pairs.extend(resume.pairs)
        built_at, built_with = resume.built_at, resume.built_with
        _recall(problem, built_with)
        apply_inverse = problem.preconditioner(built_at)
        _recall(problem, resume.memory)
    status: Status = "out-of-iterations"
    iteration = len(values) - 1
    newton = opts.method == "newton"
    while iteration < opts.max_iterations:
        if apply_inverse is None or age >= (opts.newton_refresh if newton else opts.refresh):
            apply_inverse = problem.preconditioner(x)
            built_at, built_with = x, _memory(problem)
            age = 0
        if newton:
            assert isinstance(problem, CurvedProblem)
            direction = _newton_direction(problem.hessian(x), gradient, apply_inverse, opts.inner_iterations)
        else:
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
            trial_value = problem.value(trial)
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
        trial_gradient = problem.value_and_gradient(trial)[1]
        s = trial - x
        y = trial_gradient - gradient
        sy = float(s @ y)
        if not newton and sy > 1e-10 * float(np.linalg.norm(s) * np.linalg.norm(y)):
            pairs.append((s, y, sy))
        problem.step_taken(x, direction)
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
        if checkpoint is not None and iteration < opts.max_iterations:
            now = _memory(problem)
            checkpoint(
                DescentState(
                    x, gradient, tuple(values), tuple(pairs), age, small, n_evaluations, built_at, now, built_with
                )
            )
    return Result(x, status, iteration, n_evaluations, {"value": np.array(values)})


def _memory(problem: InteriorProblem) -> Floats | None:
    return problem.memory() if isinstance(problem, RememberingProblem) else None


def _recall(problem: InteriorProblem, memory: Floats | None) -> None:
    if isinstance(problem, RememberingProblem):
        problem.recall(memory)


def _newton_direction(
    product: Callable[[Floats], Floats], gradient: Floats, apply_inverse: Callable[[Floats], Floats], most: int
) -> Floats:
    """Solve ``H d = -g`` by conjugate gradients until the residual pays no more or the curvature fails (ibid., algorithm 7.1)."""
    residual = -gradient
    z = apply_inverse(residual)
    product_rz = start = float(residual @ z)
    direction = np.zeros_like(gradient)
    search = z
    # superlinear near the solution, lazy far from it
    enough = min(0.09, np.sqrt(max(start, 0.0))) * start
    for k in range(most):
        curved = product(search)
        curvature = float(search @ curved)
        if curvature <= 1e-12 * float(search @ search):
            return z if k == 0 else direction
        a = product_rz / curvature
        direction += a * search
        residual = residual - a * curved
        z = apply_inverse(residual)
        previous, product_rz = product_rz, float(residual @ z)
        if product_rz <= enough:
            break
        search = z + (product_rz / previous) * search
    return direction


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
