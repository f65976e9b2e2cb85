"""Work on a dask cluster: patients as tasks, each in a guarded child of its worker; the group optimization in blocks.

A worker may be killed at any time: dask gives its task to another one, which finds what was finished on the disk. Output folder and
scans must be seen by all workers under the same paths, and ssmpipe must be installed where they run.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import sys
import threading
import time
import uuid
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.batch import (
    Batch,
    ClusterAddress,
    Event,
    Job,
    Outcome,
    may_have_children,
    one_thread_environment,
    record_failure,
)
from ssmpipe.runner.disk import DiskError, disk_errors
from ssmpipe.runner.patience import ClusterLostError, Patience

if TYPE_CHECKING:
    from ssmpipe.runner.config import RunConfig, SlurmConfig

_ALLOWED_DEATHS = 3
_WAIT_S = 60
_ANSWER_S = 10
_QUIET: dict[str, Any] = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
"""No page to look at, and the server that would show it is not seen by other machines."""


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine, unreachable from others.

    Examples
    --------
    >>> [is_loopback(h) for h in ("localhost", "127.0.0.1", "[::1]", "10.0.0.7", "login.cluster")]
    [True, True, True, False, False]
    """
    host = host.strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_dask(slurm: bool = False) -> None:
    """Refuse when the extra is not installed.

    Raises
    ------
    ConfigError
        If it is not.
    """
    try:
        import distributed  # noqa: F401

        if slurm:
            import dask_jobqueue  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"executor: dask needs {error.name}, which is not installed", "pip install 'ssmpipe[dask]'"
        ) from None


def check_scheduler(scheduler: str, *, encrypted: bool) -> None:
    """Refuse an address that others could reach without encryption.

    Raises
    ------
    ConfigError
        If tcp is asked for on anything but this machine, or a tls address comes without certificates.
    """
    if scheduler in ("local", "slurm"):
        return
    protocol, _, rest = scheduler.partition("://")
    host = rest.rpartition(":")[0]
    if protocol == "tcp" and not is_loopback(host):
        raise ConfigError(
            f"scheduler: {scheduler} is not on this machine and not encrypted: whoever reaches its port can run code",
            f"start the scheduler with certificates and use tls://{rest}",
        )
    if protocol == "tls" and not encrypted:
        raise ConfigError(
            f"scheduler: {scheduler} needs certificates",
            "give ca_file, cert and key under `tls`, or in dask's own configuration",
        )


def slurm_cluster(slurm: SlurmConfig, folder: Path) -> Any:
    """Return a cluster whose workers will be SLURM jobs, encrypted; nothing is submitted before it is scaled.

    Parameters
    ----------
    slurm : SlurmConfig
    folder : Path
        Seen by all nodes; gets the certificates of this run and the logs of the jobs.
    """
    from dask_jobqueue import SLURMCluster
    from distributed import Security

    with disk_errors():
        folder.mkdir(parents=True, exist_ok=True)
    return SLURMCluster(
        queue=slurm.queue,
        account=slurm.account,
        cores=slurm.cores,
        processes=slurm.cores,
        memory=slurm.memory,
        walltime=slurm.walltime,
        python=sys.executable,
        security=Security.temporary(),
        shared_temp_directory=str(folder),
        log_directory=str(folder),
        local_directory=str(folder),
        scheduler_options=_QUIET,
        job_script_prologue=["export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1"],
        job_extra_directives=list(slurm.directives),
    )


@contextmanager
def open_cluster(config: RunConfig, scheduler: str, jobs: int, folder: Path, base: Path) -> Iterator[Any]:
    """Connect to a cluster, or start one; yields a ``distributed.Client``.

    Parameters
    ----------
    config : RunConfig
    scheduler : str
        ``local``, ``slurm`` or an address.
    jobs : int
        Worker processes to start.
    folder : Path
        For what a cluster writes.
    base : Path
        What paths of certificates are relative to.

    Raises
    ------
    ConfigError
        If it cannot be reached, or asks for what is not installed or not safe.
    """
    require_dask(scheduler == "slurm")
    import dask
    from distributed import Client, LocalCluster, Security

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    tls = config.tls
    if tls is not None:
        files = {"tls_ca_file": tls.ca_file, "tls_client_cert": tls.cert, "tls_client_key": tls.key}
        for name in files.values():
            if not (base / name).is_file():
                raise ConfigError(f"tls: there is no file {base / name}", "mend the path")
        security = Security(**{key: str(base / name) for key, name in files.items()}, require_encryption=True)
    else:
        security = Security(require_encryption=scheduler.startswith("tls://") or None)
    check_scheduler(scheduler, encrypted=bool(security.tls_ca_file and security.tls_client_cert))
    cluster: Any = None
    settings = {
        "distributed.scheduler.allowed-failures": _ALLOWED_DEATHS,
        "distributed.worker.memory.terminate": False,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.admin.large-graph-warning-threshold": "1GiB",
    }
    with dask.config.set(settings), one_thread_environment():
        try:
            if scheduler == "local":
                cluster = LocalCluster(
                    n_workers=jobs,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=_QUIET["dashboard_address"],
                    scheduler_kwargs={"dashboard": False},
                    memory_limit=0,
                    local_directory=str(folder),
                    silence_logs=logging.CRITICAL,
                )
                client = Client(cluster, direct_to_workers=True)
            elif scheduler == "slurm":
                if config.slurm is None:
                    raise ConfigError(
                        "scheduler: slurm needs queue, cores, memory and walltime",
                        "write them in the config: scheduler: {slurm: {queue: ..., cores: 16, memory: 64GB, walltime: '04:00:00'}}",
                    )
                cluster = slurm_cluster(config.slurm, folder)
                cluster.scale(jobs=-(-jobs // config.slurm.cores))
                client = Client(cluster, security=cluster.security)
            else:
                client = Client(scheduler, security=security, timeout=_WAIT_S, set_as_default=False)
        except (OSError, TimeoutError) as error:
            if cluster is not None:
                cluster.close()
            raise ConfigError(
                f"scheduler: {scheduler} cannot be reached ({str(error)[:150] or type(error).__name__})",
                "check that it runs, and its certificates",
            ) from None
        try:
            yield client
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                client.close()
                if cluster is not None:
                    cluster.close()
                for secret in folder.glob(".dask-jobqueue.worker.*"):
                    secret.unlink(missing_ok=True)


@contextmanager
def connected(address: ClusterAddress) -> Iterator[Any]:
    """Connect from another process of this machine; yields a ``distributed.Client``."""
    from distributed import Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    client = Client(
        address.address,
        security=address.security,
        timeout=_WAIT_S,
        set_as_default=False,
        direct_to_workers=address.direct,
    )
    try:
        yield client
    finally:
        client.close()


# --- in a worker ---------------------------------------------------------------------------------------------------

_BATCHES: dict[tuple[str, int], Batch] = {}


def run_on_worker(job: Job, run: str, memory_mb: int | None, timeout_s: float | None) -> Outcome:
    """Run the job of one shape in a child of this worker: what crashes or hangs there does not touch the worker.

    Parameters
    ----------
    job : Job
    run : str
        Name of the run; a child is kept for its next shape.
    memory_mb, timeout_s : optional
        Limits of the child.
    """
    may_have_children()
    key = (run, threading.get_ident())
    if key not in _BATCHES:
        _BATCHES[key] = Batch(1, job.workspace.scratch, timeout_s, memory_mb)
    found: list[Outcome] = []
    try:
        _BATCHES[key].run([job], lambda _, outcome: found.append(outcome))
    except DiskError as error:
        return Outcome((), disk=str(error.strerror or error))
    return found[0]


def release(run: str) -> None:
    """End the children of a run on this worker."""
    for key in [key for key in _BATCHES if key[0] == run]:
        _BATCHES.pop(key).__exit__(None, None, None)


# --- in the parent -------------------------------------------------------------------------------------------------


@dataclass
class DaskBatch(Batch):
    """Jobs of shapes go to the workers of a cluster; group tasks run in a child here, and share their blocks with the workers.

    Parameters
    ----------
    client : distributed.Client
    address : ClusterAddress
        For the child of a group task.
    worker_wait_s : float, optional
        Longest time without any worker.
    queued : bool
        Whether it counts from the first worker on.
    """

    client: Any = None
    address: ClusterAddress | None = None
    worker_wait_s: float | None = None
    queued: bool = False
    _name: str = field(default_factory=lambda: uuid.uuid4().hex, init=False)

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        super().__exit__(kind, value, trace)
        if not isinstance(value, ClusterLostError):
            with suppress(Exception):  # workers that are gone have no children left
                self.client.run(release, self._name)

    def run(self, jobs: Sequence[Job], finished: Callable[[Job, Outcome], None]) -> None:
        """Run jobs; see :meth:`Batch.run`."""
        here = [replace(job, cluster=self.address) for job in jobs if job.shape is None]
        if here:
            super().run(here, finished)
        there = [job for job in jobs if job.shape is not None]
        if there:
            self._on_workers(there, finished)

    def _on_workers(self, jobs: Sequence[Job], finished: Callable[[Job, Outcome], None]) -> None:
        from distributed.comm import CommClosedError

        waiting = {self._submit(job, -k): job for k, job in enumerate(jobs)}
        unheard: Counter[str] = Counter()
        patience = Patience(self.client, self.worker_wait_s, from_start=not self.queued, tell=self._warn)
        try:
            while waiting:
                ready = [future for future in waiting if future.done()]
                patience.check()
                self._listen()
                for future in ready:
                    job = waiting.pop(future)
                    try:
                        outcome = self._brought(job, future)
                    except CommClosedError:  # its answer was lost on the way; whoever gets it now finds the work done
                        patience.check()
                        unheard[job.key] += 1
                        if unheard[job.key] > _ALLOWED_DEATHS:
                            raise ClusterLostError("answers of the dask workers are lost again and again") from None
                        waiting[self._submit(job, 0)] = job
                        continue
                    except (TimeoutError, asyncio.TimeoutError):  # its worker is gone, and the work is to be done again
                        waiting[future] = job
                        continue
                    if outcome.disk:
                        raise DiskError(errno.EIO, outcome.disk)
                    finished(job, outcome)
                self._watch_memory()
                if not ready:
                    time.sleep(0.05)
        finally:
            for future in waiting:
                future.cancel()

    def _submit(self, job: Job, priority: int) -> Any:
        return self.client.submit(
            run_on_worker, job, self._name, self.memory_mb, self.timeout_s, pure=False, retries=0, priority=priority
        )

    def _warn(self, text: str) -> None:
        self.on_event(Event("warning", "", "", text=text))

    def _brought(self, job: Job, future: Any) -> Outcome:
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        stage = self._steps.get(job.key, job.steps[0])
        try:
            return future.result(timeout=_ANSWER_S)
        except KilledWorker:
            fact = f"the workers that had this shape died, {_ALLOWED_DEATHS + 1} in turn"
            return Outcome(
                (), record_failure(job, stage, fact, "check the memory of the workers, or decimate more", "")
            )
        except CancelledError:  # all futures of a scheduler that is gone
            raise ClusterLostError("the dask scheduler, or the connection to it, broke down") from None
        except (CommClosedError, TimeoutError, asyncio.TimeoutError):
            raise
        except Exception as error:
            fact = f"the cluster failed: {type(error).__name__}: {str(error)[:200]}"
            return Outcome((), record_failure(job, stage, fact, "check that ssmpipe is installed on the workers", ""))
