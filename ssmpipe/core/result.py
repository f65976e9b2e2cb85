"""What an iterative method returns: a value, how it ended, and its history."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

import numpy as np

T = TypeVar("T")
Status = Literal["converged", "stalled", "out-of-iterations"]


@dataclass(frozen=True, eq=False)
class Result(Generic[T]):
    """Outcome of an iterative method; whether anything but ``converged`` is an error is the caller's choice.

    Parameters
    ----------
    value : T
        The best iterate found.
    status : {"converged", "stalled", "out-of-iterations"}
    n_iterations, n_evaluations : int
    history : dict of (n,) arrays
        One entry per iteration and recorded quantity.
    """

    value: T
    status: Status
    n_iterations: int
    n_evaluations: int = 0
    history: dict[str, np.ndarray] = field(default_factory=dict)
