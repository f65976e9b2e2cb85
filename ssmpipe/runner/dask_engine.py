"""The workers of a dask cluster that share the blocks of a group optimization.

Calls go straight to an actor in every worker: a task would pass through the scheduler twice, which costs more time than the messages
of an iteration. dask promises nothing for actors when a worker dies, so a call that one cannot answer is made again as a task; results
are the same wherever a call is made.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ssmpipe.core.engine import Arrays, Content
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.patience import ClusterLostError, Patience
from ssmpipe.runner.shared_folder import SharedFolder

RETRIES = 3
_ASK_EVERY_S = 2.0
_LOOK_EVERY_S = 5.0
_NO_ANSWER_S = 30.0


class EngineError(SsmpipeError):
    """Processes died again and again."""


class Servant:
    """The actor: stands in a worker and does what it is asked to."""

    def call(self, function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[bool, Any]:
        """Return whether a call went well, and its result or its error."""
        try:
            return True, function(*args)
        except Exception as error:  # an error of the function, told from one of the network
            return False, error

    async def alive(self) -> None:
        """Answer at once, also while a call is worked on."""


class _LostError(Exception):
    """A call that will not be answered."""


class DaskEngine:
    """The workers of a dask cluster; calls stay with their worker as long as it lives.

    Parameters
    ----------
    client : distributed.Client
    folder : Path
        For shared arrays; the workers must see it under the same path.
    worker_wait_s : float, optional
        Longest time without any worker [s].

    Attributes
    ----------
    n_tasks : int
        Calls so far that an actor could not answer.
    """

    def __init__(self, client: Any, folder: Path, worker_wait_s: float | None = None) -> None:
        self._client = client
        self._worker_wait_s = worker_wait_s
        self._folder = SharedFolder(folder)
        self._addresses: list[str] = []
        self._asked = 0.0
        # a scheduler gives the answer that it has to whoever uses a key again: the keys of two engines must differ
        self._name = uuid.uuid4().hex
        self._count = 0
        self._coming: dict[str, Any] = {}
        self._actors: dict[str, Any] = {}
        self._silent: set[str] = set()
        self.n_tasks = 0

    @property
    def n_workers(self) -> int:
        """Number of workers that are there now."""
        return max(1, len(self._places()))

    def _places(self) -> list[str]:
        now = time.monotonic()
        if not self._addresses or now - self._asked > _ASK_EVERY_S:
            with suppress(OSError):  # without a scheduler the workers may still be there
                self._addresses = sorted(place for place in self._client.nthreads() if place not in self._silent)
            self._asked = now
        return self._addresses

    def share(self, arrays: Arrays) -> Content:
        """Write arrays into the folder."""
        return self._folder.share(arrays)

    def call(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return the results in order.

        Raises
        ------
        EngineError
            If the workers of a call die four times.
        ClusterLostError
            If no worker has been there for too long, or the scheduler is gone.
        """
        places = self._places()
        self._count += 1
        asked = []
        for k, args in enumerate(arguments):
            place = places[k % len(places)] if places else ""
            answer = self._ask(place, function, args)
            asked.append((place, self._actors.get(place), answer))
        found: dict[int, tuple[bool, Any]] = {}
        for k, (place, actor, answer) in enumerate(asked):
            with suppress(_LostError):
                found[k] = self._answer(place, actor, answer)
        left = [k for k in range(len(arguments)) if k not in found]
        if left:
            self._addresses = []
            results = self._as_tasks(function, [arguments[k] for k in left])
            found.update({k: (True, result) for k, result in zip(left, results, strict=True)})
        for k in range(len(arguments)):
            if not found[k][0]:
                raise found[k][1]
        return [found[k][1] for k in range(len(arguments))]

    # --- actors ---

    def _ask(self, place: str, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Send a call; None when there is nobody to send it to."""
        try:
            return self._actor(place).call(function, args) if place else None
        except Exception:  # also what dask raises for a worker that it knows to be gone
            self._dismiss(place)
            return None

    def _actor(self, place: str) -> Any:
        if place not in self._actors:
            with self._client.as_current():  # an actor finds its client there
                if place not in self._coming:
                    key = f"servant-{self._name}-{self._count}-{place}"
                    self._coming[place] = self._client.submit(Servant, key=key, workers=[place], actor=True)
                self._actors[place] = self._coming[place].result(timeout=_NO_ANSWER_S)
        return self._actors[place]

    def _answer(self, place: str, actor: Any, answer: Any) -> tuple[bool, Any]:
        if answer is None:
            raise _LostError
        while True:
            try:
                ok, value = answer.result(timeout=_LOOK_EVERY_S)
            except Exception:
                alive = _is_alive(actor)
                if alive and not answer.done():
                    continue
                if not alive:
                    self._silent.add(place)
                self._dismiss(place)
                raise _LostError from None
            return bool(ok), value

    def _dismiss(self, place: str) -> None:
        self._actors.pop(place, None)
        self._coming.pop(place, None)  # with its last future dask forgets the actor

    # --- tasks ---

    def _as_tasks(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        from distributed import CancelledError, KilledWorker

        places = self._places()
        self.n_tasks += len(arguments)
        patience = Patience(self._client, self._worker_wait_s)
        patience.check()
        futures = [
            self._client.submit(
                function,
                *args,
                key=f"{function.__name__}-{self._name}-{self._count}-{k}",
                workers=[places[k % len(places)]] if places else None,
                allow_other_workers=bool(places),
                retries=RETRIES,
                pure=False,
            )
            for k, args in enumerate(arguments)
        ]
        try:
            return [self._result(future, patience) for future in futures]
        except CancelledError:
            raise ClusterLostError("the dask scheduler, or the connection to it, broke down") from None
        except KilledWorker as error:
            raise EngineError(
                f"workers died again and again: {str(error)[:200]}",
                "give them more memory, or use more landmark_blocks",
            ) from None

    def _result(self, future: Any, patience: Patience) -> Any:
        while True:
            try:
                return future.result(timeout=_ASK_EVERY_S)
            except (TimeoutError, asyncio.TimeoutError):  # two classes before Python 3.11
                if future.status == "error":
                    raise
                patience.check()

    def close(self) -> None:
        """Remove the shared files; the client belongs to who made it."""
        self._actors.clear()
        self._coming.clear()
        self._folder.clear()


def _is_alive(actor: Any) -> bool:
    try:
        actor.alive().result(timeout=_NO_ANSWER_S)
    except Exception:
        return False
    return True
