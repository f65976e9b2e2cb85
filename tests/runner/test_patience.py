"""A cluster whose workers are gone is waited for, but not for ever."""

from __future__ import annotations

import pickle
from typing import Any

import pytest

from ssmpipe.runner.patience import ClusterLostError, Patience


class Client:
    """A cluster in which workers come and go as the test says."""

    def __init__(self) -> None:
        self.status, self.workers, self.time, self.n_asked = "running", {"tcp://1": 1}, 0.0, 0
        self.said: list[str] = []

    def nthreads(self) -> dict[str, int]:
        self.n_asked += 1
        if self.workers is None:
            raise OSError("no scheduler")
        return self.workers

    def patience(self, limit_s: float | None = 10.0, **options: Any) -> Patience:
        return Patience(self, limit_s, tell=self.said.append, clock=lambda: self.time, **options)

    def at(self, time: float, patience: Patience) -> None:
        self.time = time
        patience.check()


@pytest.mark.parametrize("gone", [{}, None, "connecting"])
def test_workers_that_vanish_are_waited_for_and_then_missed(gone: Any) -> None:
    client = Client()
    patience = client.patience()
    client.at(0, patience)
    if gone == "connecting":
        client.status = gone
    else:
        client.workers = gone
    client.at(4, patience)
    client.at(9, patience)
    assert client.said == ["no dask worker is there; the run waits up to 10 s for one"]
    with pytest.raises(ClusterLostError, match="no dask worker has been there for 10 s; try: start the cluster again"):
        client.at(12, patience)


def test_workers_that_come_back_are_forgiven() -> None:
    client = Client()
    patience = client.patience()
    for k in range(5):
        client.workers = {} if k % 2 else {"tcp://2": 1}
        client.at(8.0 * k, patience)
    assert len(client.said) == 2


def test_before_the_first_worker_a_queue_may_last() -> None:
    client = Client()
    client.workers = {}
    patience = client.patience(from_start=False)
    client.at(1e6, patience)
    client.workers = {"tcp://1": 1}
    client.at(2e6, patience)
    client.workers = {}
    with pytest.raises(ClusterLostError):
        client.at(2e6 + 11, patience)
    impatient = client.patience()
    with pytest.raises(ClusterLostError):
        client.at(2e6 + 23, impatient)


def test_without_a_limit_only_a_lost_scheduler_ends_the_run() -> None:
    client = Client()
    client.workers = {}
    patience = client.patience(None)
    client.at(1e6, patience)
    client.status = "closed"
    with pytest.raises(ClusterLostError, match="the connection to the dask scheduler is lost"):
        client.at(1e6, patience)


def test_the_scheduler_is_not_asked_all_the_time_and_the_error_reaches_the_parent() -> None:
    client = Client()
    patience = client.patience()
    for k in range(100):
        client.at(0.05 * k, patience)
    assert client.n_asked == 3
    error = pickle.loads(pickle.dumps(ClusterLostError("gone")))
    assert str(error) == str(ClusterLostError("gone"))
    assert error.fact == "gone"
