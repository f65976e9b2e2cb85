"""What a long computation hands out so that it can be continued: plain arrays, and when to hand them out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = Mapping[str, NDArray[Any]]

LAYOUT = 1
"""Raised when the arrays of a state change their meaning; a state of another layout is of no use."""


@dataclass(frozen=True)
class Checkpoints:
    """Where states go, how often, and the one to continue from.

    Parameters
    ----------
    save : callable
        Gets a state: arrays by name, none of them changed afterwards. It must be on the disk when this returns.
    every : int, default=10
        Iterations between two states.
    resume : mapping of str to array, optional
        A state that was saved by the same computation with the same input and options.
    """

    save: Callable[[State], None]
    every: int = 10
    resume: State | None = None


def within(state: State, prefix: str) -> dict[str, NDArray[Any]]:
    """Return the part of a state whose names begin with ``prefix/``, without it.

    Examples
    --------
    >>> within({"a/x": np.zeros(1), "b": np.ones(1)}, "a")
    {'x': array([0.])}
    """
    return {name[len(prefix) + 1 :]: np.asarray(a) for name, a in state.items() if name.startswith(f"{prefix}/")}


def under(state: State, prefix: str) -> dict[str, NDArray[Any]]:
    """Return a state with ``prefix/`` before every name.

    Examples
    --------
    >>> under({"x": np.zeros(1)}, "a")
    {'a/x': array([0.])}
    """
    return {f"{prefix}/{name}": a for name, a in state.items()}
