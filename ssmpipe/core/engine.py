"""Where the blocks of a large computation are evaluated: what an engine must do, without saying how."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from numpy.typing import NDArray

Arrays: TypeAlias = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Content:
    """Arrays that every process can read for itself: a digest of them, and a function without arguments that returns them."""

    key: str
    load: Callable[[], Arrays]


class Engine(Protocol):
    """Processes that evaluate functions; results may not depend on which process evaluates what.

    A process may die at any time: its work is then done by another one, which finds nothing in its memory.
    """

    @property
    def n_workers(self) -> int:
        """Return how many calls are worth making at once."""

    def share(self, arrays: Arrays) -> Content:
        """Put arrays where all processes can read them."""

    def call(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return the results of a module's function in order; the k-th call goes to the same process each time, while it lives."""
