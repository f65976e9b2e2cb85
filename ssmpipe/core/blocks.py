"""Fixed blocks of work that threads may share: the same blocks and the same order of sums for any number of threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, Generic, TypeVar, cast

T = TypeVar("T")
_HERE = threading.local()
_HELPERS: dict[int, tuple[threading.Thread, list[SimpleQueue[_Shared[Any]]]]] = {}


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
        If it is called with threads from inside a block: the inner blocks would wait for the threads that wait for them.

    Examples
    --------
    >>> map_blocks(lambda s: sum(range(10)[s]), 10, 4)
    [1, 9, 11, 24]
    """
    if threads > 1 and getattr(_HERE, "in_block", False):
        raise AssertionError(
            "map_blocks was called with threads from inside a block: they would wait for each other for ever"
        )
    count = -(-n // size)
    count += count % 2 if 1 < count < n else 0  # two threads then get the same
    slices = [slice(n * k // count, n * (k + 1) // count) for k in range(count)]
    if threads <= 1 or count <= 1:
        return [function(s) for s in slices]
    shared = _Shared(function, slices)
    for inbox in _helpers(threads - 1)[: count - 1]:
        inbox.put(shared)
    return shared.answers()


class _Shared(Generic[T]):
    """Blocks that threads take one after the other. Nobody waits for a helper that has not woken up: its share is taken by others."""

    def __init__(self, function: Callable[[slice], T], slices: list[slice]) -> None:
        self._function, self._slices = function, slices
        self._lock = threading.Lock()
        self._taken = self._helped = 0
        self._answers: dict[int, T] = {}
        self._failed: dict[int, BaseException] = {}
        self._finished: SimpleQueue[None] = SimpleQueue()

    def help(self) -> None:
        """Take blocks on another thread than the caller's until none is left or one has failed."""
        _HERE.in_block = True  # always, on a thread of ours
        while (k := self._take(helps=1)) is not None:
            try:
                self._answers[k] = self._function(self._slices[k])
            except BaseException as error:
                self._failed[k] = error
            finally:
                self._finished.put(None)

    def answers(self) -> list[T]:
        """Take blocks, wait for those that helpers took, and return all answers in order.

        What a block raises is raised when no block runs any more, and so is an interrupt: blocks write into memory that the next
        call uses.
        """
        k: int | None = None
        _HERE.in_block = True
        try:
            while (k := self._take()) is not None:
                self._answers[k] = self._function(self._slices[k])
        except BaseException as error:
            self._failed.setdefault(-1 if k is None else k, error)
        finally:
            _HERE.in_block = False
        with self._lock:
            left = self._helped
        while left:
            try:
                self._finished.get()
                left -= 1
            except BaseException as error:
                self._failed.setdefault(-1, error)
        if self._failed:
            raise self._failed[min(self._failed)]
        return [self._answers[k] for k in range(len(self._slices))]

    def _take(self, helps: int = 0) -> int | None:
        with self._lock:
            if self._taken == len(self._slices) or self._failed:
                return None
            self._taken += 1
            self._helped += helps
            return self._taken - 1


def side_by_side(function: Callable[[], T], other: Callable[[], object], threads: int = 1) -> T:
    """Return ``function()`` after both have run, each on a thread of its own if there are two.

    Examples
    --------
    >>> seen = []
    >>> side_by_side(lambda: 3, lambda: seen.append(4)), seen
    (3, [4])
    """
    if threads <= 1:
        other()
        return function()
    answers = map_blocks(lambda one: other() if one.start else function(), 2, 1, threads)
    return cast("T", answers[0])


def _helpers(n: int) -> list[SimpleQueue[_Shared[Any]]]:
    """Return the inboxes of ``n`` threads; kept: new threads come with new memory, whose first touch costs more than a block.

    A queue and no executor: an executor takes as long to start and end as a small block. In a forked child they are made anew, since
    threads do not come along.
    """
    known = _HELPERS.get(n)
    if known is None or not known[0].is_alive():
        inboxes: list[SimpleQueue[_Shared[Any]]] = [SimpleQueue() for _ in range(n)]
        threads = [threading.Thread(target=_help, args=(inbox,), daemon=True) for inbox in inboxes]
        for thread in threads:
            thread.start()
        known = _HELPERS[n] = (threads[0], inboxes)
    return known[1]


def _help(inbox: SimpleQueue[_Shared[Any]]) -> None:
    while True:
        inbox.get().help()
