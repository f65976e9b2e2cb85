"""Processes of this machine that share the blocks of a group optimization, and the folder of arrays that any engine shares.

Arrays are shared as files in a folder that all processes see. A process that dies is replaced; the calls it had are made again,
elsewhere, and find nothing in the memory of the process: the functions make it anew from the files.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.engine import Arrays, Content
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.disk import replacing

_KEPT = 2
RETRIES = 3


class EngineError(SsmpipeError):
    """Processes died again and again."""


@dataclass(frozen=True)
class ArrayFile:
    """Arrays in a file; read wherever it is called."""

    path: Path

    def __call__(self) -> Arrays:
        """Return the arrays."""
        with self.path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


class SharedFolder:
    """Arrays as files named by their digest; the last few are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: list[Path] = []

    def share(self, arrays: Arrays) -> Content:
        """Write arrays, once."""
        digest = hashlib.sha256()
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
        key = digest.hexdigest()
        path = self.folder / f"{key}.npz"
        if not path.is_file():
            with replacing(path) as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
        self._files = [other for other in self._files if other != path] + [path]
        for old in self._files[:-_KEPT]:
            old.unlink(missing_ok=True)
        self._files = self._files[-_KEPT:]
        return Content(key, ArrayFile(path))

    def clear(self) -> None:
        """Remove the files."""
        for path in self._files:
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()


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

    from ssmpipe.runner.batch import die_with

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


def may_have_children() -> None:
    """Let this process start others although it is itself a child that ends with its parent: ours end with theirs, too."""
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
