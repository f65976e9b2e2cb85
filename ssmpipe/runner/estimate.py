"""What the group stages will cost, said before hours are spent: a cost model with constants that a benchmark measured.

The terms are those of the work: evaluation grows with ``n_S n_L`` (shapes, landmarks), the Gram products with ``n_S^2 n_L``, the
preconditioner with ``n_S n_b^2`` (coefficients of one map), eigenvalues with ``n_S^3``. ``python -m benchmarks.group_cost`` prints
the constants. Its sizes took 0.7 to 2.4 times the fitted time and 0.9 to 1.2 times the fitted memory, for how many iterations a
cohort needs is not known before. Machines differ as well: expect a third to three times the time, half to twice the memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ssmpipe.runner.plan import Plan

# printed by benchmarks/group_cost.py on 25 November 2026, 5 to 160 shapes, normals included; products and eigenvalues do not show at
# these sizes and come from the section "Growth" of docs/engine_speed.md (1000 shapes, 100 iterations; normals double the products)
IDLE_MB = 98.0
OPTIMIZE_S = (0.68, 3.4e-5, 3.2e-8, 4.4e-6, 2.0e-8)
EVALUATE_S = (4.8e-3, 0.0, 2.6e-8, 2.5e-8)
MEMORY_MB = (115.0, 6.0e-4, 9.0e-5)
TIME_FACTOR = 3.0
MEMORY_FACTOR = 2.0


def optimize_terms(n_shapes: int, n_landmarks: int, n_coefficients: int) -> tuple[float, ...]:
    """Return the terms of the time of ``optimize``: fixed, evaluation, products, preconditioner, eigenvalues."""
    n = float(n_shapes)
    return (1.0, n * n_landmarks, n**2 * n_landmarks, n * n_coefficients**2, n**3)


def evaluate_terms(n_shapes: int, n_landmarks: int) -> tuple[float, ...]:
    """Return the terms of the time of ``model`` and ``evaluate``: fixed, linear, products, one eigenproblem for every shape."""
    n = float(n_shapes)
    return (1.0, n * n_landmarks, n**2 * n_landmarks, n**4)


def memory_terms(n_shapes: int, n_landmarks: int, n_coefficients: int) -> tuple[float, ...]:
    """Return the terms of the memory: fixed, arrays over all landmarks, preconditioners."""
    return (1.0, float(n_shapes) * n_landmarks, float(n_shapes) * n_coefficients**2)


@dataclass(frozen=True)
class Estimate:
    """Expected cost of the group stages on one core.

    Parameters
    ----------
    n_shapes, n_landmarks, n_coefficients : int
        What it follows from; coefficients of one map.
    seconds : float
        Of all group stages together.
    memory_mb : float
        Largest resident memory of their process.
    """

    n_shapes: int
    n_landmarks: int
    n_coefficients: int
    seconds: float
    memory_mb: float

    @property
    def text(self) -> str:
        """One line for people, with the range."""
        low, high = self.seconds / TIME_FACTOR, self.seconds * TIME_FACTOR
        return (
            f"group stages, {self.n_shapes} shapes x {self.n_landmarks} landmarks x {self.n_coefficients} coefficients: about "
            f"{duration(self.seconds)} on one core (expected between {duration(low)} and {duration(high)}), "
            f"{memory(self.memory_mb / MEMORY_FACTOR)} to {memory(self.memory_mb * MEMORY_FACTOR)} of memory"
        )


def estimate(n_shapes: int, landmarks: tuple[int, ...], n_coefficients: tuple[int, ...]) -> Estimate:
    """Return the expected cost for a cohort.

    Parameters
    ----------
    n_shapes : int
    landmarks, n_coefficients : tuple of int
        Per direction.

    Examples
    --------
    >>> small, large = estimate(10, (51, 51), (8, 8)), estimate(100, (51, 51), (8, 8))
    >>> large.seconds > 5 * small.seconds and large.memory_mb > small.memory_mb
    True
    """
    n_landmarks, n_b = math.prod(landmarks), math.prod(n_coefficients)
    work = _sum(OPTIMIZE_S, optimize_terms(n_shapes, n_landmarks, n_b))
    rest = _sum(EVALUATE_S, evaluate_terms(n_shapes, n_landmarks))
    held = IDLE_MB + _sum(MEMORY_MB, memory_terms(n_shapes, n_landmarks, n_b))
    return Estimate(n_shapes, n_landmarks, n_b, work + rest, held)


def estimate_plan(plan: Plan, n_shapes: int) -> Estimate | None:
    """Return the expected cost of the group stages of a plan; None where it has no ``optimize``."""
    for step in plan.steps:
        if step.stage == "optimize":
            options: Mapping[str, Any] = step.options
            return estimate(n_shapes, tuple(options["landmarks"]), tuple(options["n_coefficients"]))
    return None


def duration(seconds: float) -> str:
    """Return a time as people say it.

    Examples
    --------
    >>> duration(3.2), duration(200), duration(9000), duration(400000)
    ('3 s', '3 min', '2.5 h', '4.6 days')
    """
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.1f} days"


def memory(mb: float) -> str:
    """Return a size as people say it.

    Examples
    --------
    >>> memory(151), memory(2500)
    ('0.2 GB', '2.5 GB')
    """
    return f"{mb / 1000:.1f} GB"


def _sum(constants: tuple[float, ...], terms: tuple[float, ...]) -> float:
    return sum(c * t for c, t in zip(constants, terms, strict=True))
