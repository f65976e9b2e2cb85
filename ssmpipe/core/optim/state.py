"""The state of a descent between two iterations: all that its further iterates depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import State

Pair = tuple[Floats, Floats, float]


@dataclass(frozen=True, eq=False)
class DescentState:
    """Where :func:`ssmpipe.core.optim.interior.minimize_interior` stands after an iteration.

    Parameters
    ----------
    x, gradient : (n,) float64
    values : sequence of float
        Of all iterates so far; the last one belongs to ``x``.
    pairs : sequence of (s, y, s'y)
        Memory of the quasi-Newton update, oldest first.
    age : int
        Iterations since the preconditioner was built.
    small : int
        Small decreases in a row.
    n_evaluations : int
    built_at : (n,) float64
        Where the preconditioner was built.
    memory, built_with : float64 array, optional
        What the problem remembers, now and when the preconditioner was built.
    """

    x: Floats
    gradient: Floats
    values: Sequence[float]
    pairs: Sequence[Pair]
    age: int
    small: int
    n_evaluations: int
    built_at: Floats
    memory: Floats | None = None
    built_with: Floats | None = None

    def arrays(self) -> State:
        """Return the state as arrays by name."""
        out = {
            "x": self.x,
            "gradient": self.gradient,
            "values": np.array(self.values),
            "counts": np.array([self.age, self.small, self.n_evaluations]),
            "s": np.array([s for s, _, _ in self.pairs]).reshape(len(self.pairs), self.x.size),
            "y": np.array([y for _, y, _ in self.pairs]).reshape(len(self.pairs), self.x.size),
            "sy": np.array([sy for _, _, sy in self.pairs], dtype=float),
            "built_at": self.built_at,
        }
        for name, value in (("memory", self.memory), ("built_with", self.built_with)):
            if value is not None:
                out[name] = value
        return out

    @classmethod
    def of(cls, arrays: State) -> DescentState:
        """Return the state that :meth:`arrays` described."""
        age, small, n_evaluations = (int(k) for k in arrays["counts"])
        return cls(
            x=np.array(arrays["x"]),
            gradient=np.array(arrays["gradient"]),
            values=[float(v) for v in arrays["values"]],
            pairs=[
                (np.array(s), np.array(y), float(sy))
                for s, y, sy in zip(arrays["s"], arrays["y"], arrays["sy"], strict=True)
            ],
            age=age,
            small=small,
            n_evaluations=n_evaluations,
            built_at=np.array(arrays["built_at"]),
            memory=None if "memory" not in arrays else np.array(arrays["memory"]),
            built_with=None if "built_with" not in arrays else np.array(arrays["built_with"]),
        )
