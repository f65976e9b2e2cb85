"""An engine of processes of this machine, for comparison: no run uses it, because threads do the same in one memory (docs/scale.md).

It is the smallest engine whose processes may die, so the tests hold the promise of equal bits against it where dask is not installed.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from ssmpipe.core.engine import Arrays, Content
from ssmpipe.runner.batch import die_with, may_have_children
from ssmpipe.runner.dask_engine import RETRIES, EngineError
from ssmpipe.runner.shared_folder import SharedFolder


class ProcessEngine:
    """Processes of this machine, each with a pipe; what they remember stays with them from call to call.

    Parameters
    ----------
    n_workers : int
    folder : Path
        For shared arrays.

    Attributes
    ----------
    bytes_moved : int
        Through the pipes so far, both ways.
    """

    def __init__(self, n_workers: int, folder: Path) -> None:
        self._folder = SharedFolder(folder)
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[tuple[Any, Connection] | None] = [None] * n_workers
        self.bytes_moved = 0

    @property
    def n_workers(self) -> int:
        """Number of processes."""
        return len(self._workers)

    @property
    def pids(self) -> list[int]:
        """Of the processes that were started."""
        return [worker[0].pid for worker in self._workers if worker is not None]

    def share(self, arrays: Arrays) -> Content:
        """Write arrays into the folder."""
        return self._folder.share(arrays)

    def call(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return the results in order; the k-th call goes to process k modulo their number.

        Raises
        ------
        EngineError
            If the process of a call dies four times.
        """
        texts = [pickle.dumps((function, args), protocol=5) for args in arguments]
        results: list[Any] = [None] * len(texts)
        try:
            for first in range(0, len(texts), self.n_workers):
                now = range(first, min(first + self.n_workers, len(texts)))
                sent = [self._send(k - first, texts[k]) for k in now]
                for k, ok in zip(now, sent, strict=True):
                    results[k] = self._answer(k - first, texts[k], ok)
        except BaseException:
            self._drop_all()  # answers that nobody took would be taken for those of the next call
            raise
        return results

    def _send(self, place: int, text: bytes) -> bool:
        worker = self._workers[place]
        if worker is None:
            here, there = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(there, os.getpid()), daemon=True)
            may_have_children()
            process.start()
            there.close()
            worker = self._workers[place] = (process, here)
        try:
            worker[1].send_bytes(text)
        except OSError:
            return False
        self.bytes_moved += len(text)
        return True

    def _answer(self, place: int, text: bytes, sent: bool) -> Any:
        for _ in range(1 + RETRIES):
            worker = self._workers[place]
            if sent and worker is not None:
                try:
                    answer = worker[1].recv_bytes()
                except (EOFError, OSError):
                    pass
                else:
                    self.bytes_moved += len(answer)
                    ok, value = pickle.loads(answer)
                    if ok:
                        return value
                    raise value
            self._drop(place)
            sent = self._send(place, text)
        raise EngineError(
            f"a process of the engine died {1 + RETRIES} times in the same call",
            "use fewer --jobs: memory may be short",
        )

    def _drop(self, place: int) -> None:
        worker, self._workers[place] = self._workers[place], None
        if worker is not None:
            worker[1].close()
            worker[0].kill()
            worker[0].join()

    def _drop_all(self) -> None:
        for place in range(self.n_workers):
            self._drop(place)

    def close(self) -> None:
        """End the processes."""
        self._drop_all()
        self._folder.clear()

    def __enter__(self) -> ProcessEngine:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def _serve(pipe: Connection, parent: int) -> None:
    from threadpoolctl import threadpool_limits

    die_with(parent)
    threadpool_limits(1)
    while True:
        try:
            function, args = pickle.loads(pipe.recv_bytes())
        except EOFError:
            return
        try:
            answer = (True, function(*args))
        except Exception as error:
            answer = (False, error)
        pipe.send_bytes(pickle.dumps(answer, protocol=5))
