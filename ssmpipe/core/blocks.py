"""Fixed blocks of work that threads may share: the same blocks and the same order of sums for any number of threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

T = TypeVar("T")
_HERE = threading.local()


def map_blocks(function: Callable[[slice], T], n: int, size: int, threads: int = 1) -> list[T]:
    """Return ``function`` of consecutive slices of ``range(n)``, in order: nearly equal ones, an even number if more than one.

    Parameters
    ----------
    function : callable
        Of a slice; blocks must be independent of each other. With threads it pays where it releases the interpreter lock.
    n, size : int
        Total and largest block length; neither may depend on ``threads`` if bits shall not.
    threads : int, default=1

    Raises
    ------
    AssertionError
        If it is called from inside a block: with threads the inner blocks would wait for the threads that wait for them.

    Examples
    --------
    >>> map_blocks(lambda s: sum(range(10)[s]), 10, 4)
    [1, 9, 11, 24]
    """
    if getattr(_HERE, "in_block", False):
        raise AssertionError(
            "map_blocks was called from inside a block, whose threads would wait for each other for ever"
        )
    count = -(-n // size)
    count += count % 2 if count > 1 else 0  # two threads then get the same
    slices = [slice(n * k // count, n * (k + 1) // count) for k in range(count)]
    out: dict[int, T] = {}
    left = iter(enumerate(slices))

    def work() -> None:
        _HERE.in_block = True
        try:
            for k, s in left:
                out[k] = function(s)
        finally:
            _HERE.in_block = False

    if threads <= 1 or len(slices) <= 1:
        work()
        return [out[k] for k in range(len(slices))]

    # the calling thread works too, and the others are woken once each: a wake costs as much as a small block
    others = [_pool(threads).submit(work) for _ in range(min(threads, len(slices)) - 1)]
    try:
        work()
    finally:
        busy = [other for other in others if not other.cancel()]  # who has not woken up yet is not waited for
        wait(busy)
    for other in busy:
        other.result()
    return [out[k] for k in range(len(slices))]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    # kept: new threads come with new memory, whose first touch costs more than the work of a block
    return ThreadPoolExecutor(threads - 1)
