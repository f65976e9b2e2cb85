"""Notice that nobody is left to do the work: a dask cluster without workers waits in silence and without end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from ssmpipe.core.errors import SsmpipeError

_ASK_EVERY_S = 2.0
_REMEDY = (
    "start the cluster again and run the same command, what is finished is kept; limits.worker_wait_s is how long a run waits "
    "for workers"
)


class ClusterLostError(SsmpipeError):
    """The workers of a cluster, or its scheduler, are gone; no shape is to blame."""

    def __init__(self, fact: str, remedy: str | None = _REMEDY) -> None:
        super().__init__(fact, remedy)


class Patience:
    """Waits for workers, but not for ever.

    Parameters
    ----------
    client : distributed.Client
    limit_s : float, optional
        Longest time without any worker [s]; without it there is no limit.
    from_start : bool
        Whether the time counts before there was a first worker; jobs of a batch system may be queued for days.
    tell : callable
        Gets one line when the waiting begins.
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        client: Any,
        limit_s: float | None,
        *,
        from_start: bool = True,
        tell: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client, self._limit_s, self._tell, self._clock = client, limit_s, tell, clock
        self._asked = float("-inf")
        self._seen: float | None = clock() if from_start else None
        self._said = False

    def check(self) -> None:
        """Look for workers, every two seconds at most.

        Raises
        ------
        ClusterLostError
            If the connection was given up, or no worker has been there for too long.
        """
        if self._client.status in ("closing", "closed"):
            raise ClusterLostError("the connection to the dask scheduler is lost")
        now = self._clock()
        if now - self._asked < _ASK_EVERY_S:
            return
        self._asked = now
        if self._any():
            self._seen, self._said = now, False
            return
        if self._seen is None or self._limit_s is None:
            return
        if not self._said and now > self._seen:
            self._said = True
            self._tell(f"no dask worker is there; the run waits up to {self._limit_s:g} s for one")
        if now - self._seen > self._limit_s:
            raise ClusterLostError(f"no dask worker has been there for {self._limit_s:g} s")

    def _any(self) -> bool:
        if self._client.status != "running":  # it tries to reach the scheduler again
            return False
        try:
            return bool(self._client.nthreads())
        except Exception:  # of many kinds; what counts is that nobody answered
            return False
