"""Tasks in disposable child processes: what crashes, hangs or ends the process in one shape does not touch the others.

Children get one BLAS thread each, fixed before numpy is loaded, so results do not depend on the number of jobs. They tell
what they are doing by appending lines to an event file, which survives whatever happens to them.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import platform
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock

from ssmpipe.core.engine import Engine
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.disk import DiskError, write_atomically
from ssmpipe.runner.execute import TaskRecord, failure_of, run_task
from ssmpipe.runner.patience import ClusterLostError
from ssmpipe.runner.workspace import Workspace

FAILED = "failed.txt"
COHORT = "(cohort)"
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "IGL_NUM_THREADS",
)


@dataclass(frozen=True)
class ClusterAddress:
    """Where a child finds the workers of a dask cluster; ``direct``: it may speak to them without the scheduler."""

    address: str
    security: Any = None
    direct: bool = False
    worker_wait_s: float | None = None


@dataclass(frozen=True)
class Closing:
    """What is done with a shape when its stages are through, in the same child; returns warnings.

    ``run`` must be importable by name, or a ``functools.partial`` of such a function, to reach the child.
    """

    name: str
    run: Callable[[Workspace, str], Sequence[str]]


@dataclass(frozen=True)
class Job:
    """Work for one child process: a shape through consecutive stages, or one task for the cohort."""

    workspace: Workspace
    steps: tuple[str, ...]
    shape: str | None
    ids: tuple[str, ...] = ()
    forced: frozenset[str] = frozenset()
    prepare: bool = False
    lock: Path | None = None
    """Held during the job, where several runs share a folder: one waits for the other and then finds the work done."""
    checkpoint_every: int | None = None
    """Iterations between two saved states of a group stage."""
    cluster: ClusterAddress | None = None
    """Workers that share a group stage."""
    closing: Closing | None = None
    threads: int = 1
    """That a group stage may use: the cores of the children that have nothing to do meanwhile."""
    timeout_s: float | None = None
    """A limit of its own in place of that of all shapes."""
    aside: bool = False
    """It is not about the stages of the shape: what is noted of their failure stays as it is."""

    @property
    def key(self) -> str:
        """Name of the job in events: the shape id, or what stands for the cohort."""
        return self.shape or COHORT


@dataclass(frozen=True)
class Failure:
    """Why a shape (or the cohort) stopped, and where."""

    shape: str
    stage: str
    file: str
    error: str
    remedy: str
    internal: bool = False
    log: str = ""

    @property
    def line(self) -> str:
        """One line: patient, stage, file, fact, remedy."""
        where = ", ".join(part for part in (self.shape, self.stage, self.file) if part)
        return f"{where}: {self.error}" + (f"; try: {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class Outcome:
    """What a job brought: its finished tasks, and what stopped it.

    ``disk`` is set when the output cannot be written, ``lost`` when the cluster is gone.
    """

    records: tuple[TaskRecord, ...]
    failure: Failure | None = None
    disk: str = ""
    lost: str = ""


@dataclass
class Event:
    """A sign of life of a child."""

    kind: str
    key: str
    step: str
    done: int = 0
    total: int = 0
    text: str = ""


def run_job(job: Job, events: Path, memory_mb: int | None) -> Outcome:
    """Run a job; called in the child process."""
    with FileLock(job.lock) if job.lock is not None else nullcontext():
        return _run_job(job, events, memory_mb)


@contextmanager
def _engine(job: Job) -> Iterator[Engine | None]:
    if job.cluster is None:
        yield None
        return
    from ssmpipe.runner.cluster import connected
    from ssmpipe.runner.dask_engine import DaskEngine

    with connected(job.cluster) as client:
        engine = DaskEngine(client, job.workspace.scratch / "shared", job.cluster.worker_wait_s)
        try:
            yield engine
        finally:
            engine.close()


def _run_job(job: Job, events: Path, memory_mb: int | None) -> Outcome:
    records: list[TaskRecord] = []
    scans: dict[str, dict[str, Any]] = {}
    current = ""
    tell = _Teller(events, job.key)
    try:
        for step_id in job.steps:
            step, current = job.workspace.plan.step(step_id), step_id
            with _engine(job) as engine:
                record = run_task(
                    job.workspace,
                    step,
                    job.shape,
                    job.ids,
                    force=step_id in job.forced,
                    prepare=job.prepare,
                    progress=tell.progress(step_id),
                    scans=scans,
                    started=lambda step_id=step_id: tell("start", step_id),  # type: ignore[misc]
                    checkpoint_every=job.checkpoint_every,
                    engine=engine,
                    threads=job.threads,
                )
            records.append(record)
            tell("done", step_id, text=record.status)
        if job.closing is not None and job.shape is not None:
            current = job.closing.name
            tell("start", current)
            begin = time.perf_counter()
            warnings = tuple(job.closing.run(job.workspace, job.shape))
            seconds = time.perf_counter() - begin
            records.append(TaskRecord(current, job.shape, "done", "", warnings=warnings, seconds=seconds))
            tell("done", current)
    except DiskError as error:
        return Outcome(tuple(records), disk=f"{error.strerror or error}: {error.filename or job.workspace.out}")
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            return Outcome(tuple(records), disk=f"{error.strerror}: {error.filename or job.workspace.out}")
        return Outcome(tuple(records), _failure(job, current, error, memory_mb))
    except ClusterLostError as error:
        return Outcome(tuple(records), lost=error.fact)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also SystemExit: some mesh libraries end the process on a bad file
        return Outcome(tuple(records), _failure(job, current, error, memory_mb))
    if job.shape is not None and not job.aside:
        (job.workspace.out / "shapes" / job.shape / FAILED).unlink(missing_ok=True)
    return Outcome(tuple(records))


def _failure(job: Job, stage: str, error: BaseException, memory_mb: int | None) -> Failure:
    fact, remedy, internal = failure_of(error, memory_mb)
    text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    return record_failure(job, stage, fact, remedy, text, internal=internal)


def record_failure(job: Job, stage: str, fact: str, remedy: str, details: str, *, internal: bool = False) -> Failure:
    """Store what is known about a failure beside the shape's stages (or in the cohort folder)."""
    out = job.workspace.out
    folder = out / "shapes" / job.shape if job.shape else out / "cohort"
    file = job.workspace.sources[job.shape].path.name if job.shape else ""
    if job.aside:
        return Failure(job.key, stage, file, fact, remedy, internal)
    failure = Failure(job.key, stage, file, fact, remedy, internal, str((folder / FAILED).relative_to(out)))
    write_atomically(folder / FAILED, f"{failure.line}\n\n{details}")
    return failure


class _Teller:
    """Append events to a file; a line is one write, so lines of different children do not mix."""

    def __init__(self, path: Path, key: str) -> None:
        self.path, self.key, self.last = path, key, 0.0

    def __call__(self, kind: str, step: str, done: int = 0, total: int = 0, text: str = "") -> None:
        line = json.dumps([kind, self.key, step, done, total, text[:200]]) + "\n"
        try:
            handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            try:
                os.write(handle, line.encode())
            finally:
                os.close(handle)
        except OSError:
            return  # progress is a courtesy; a full disk is reported by who writes results

    def progress(self, step: str) -> Callable[[int, int, str], None]:
        def tell(done: int, total: int, text: str) -> None:
            now = time.monotonic()
            if now - self.last > 0.2 or done == total:
                self.last = now
                self("progress", step, int(done), int(total), str(text))

        return tell


def start_child(memory_mb: int | None, noise: str, parent: int, events: Path | None = None) -> None:
    """Prepare a fresh child: limits, one thread, no library chatter on the user's terminal, and no life without parent."""
    die_with(parent)
    if memory_mb is not None:
        unlimited = limit_memory(memory_mb)
        if unlimited and events is not None:
            _Teller(events, "")("warning", "", text=unlimited)
    sink = os.open(noise, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(sink, stream)
    os.close(sink)
    import numpy  # noqa: F401  (its threads can only be limited once it is there)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def limit_memory(memory_mb: int) -> str:
    """Limit the address space of this process; return why that cannot be done, or nothing."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory_mb * 2**20, memory_mb * 2**20))
    except ImportError:  # Windows
        reason = "this system has no such limit"
    except (ValueError, OSError, OverflowError) as error:  # macOS; a container or a shell whose own limit is lower
        reason = f"the system refuses it: {error}"
    else:
        return ""
    return f"children run without limits.memory_mb: {memory_mb} ({reason}); watch the memory, or use fewer --jobs"


def may_have_children() -> None:
    """Let this process start others although it is itself a child that ends with its parent: ours end with theirs, too."""
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def die_with(parent: int) -> None:
    """End this process when its parent is gone: an orphan must not write beside the next run."""
    if platform.system() == "Linux":
        import ctypes

        pr_set_pdeathsig, sigkill = 1, 9
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, sigkill)
        if os.getppid() != parent:
            os._exit(1)
        return

    origin = multiprocessing.parent_process()

    def watch() -> None:
        if origin is not None:
            origin.join()  # waits for the end of the parent on every system
        else:
            while os.getppid() == parent:
                time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def one_thread_environment() -> Iterator[None]:
    """Set the thread counts that children inherit; the parent's own are restored."""
    old = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in old.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def quiet_tracker() -> None:
    """Start the process that clears up behind a killed run; it does so in silence, there is nothing to be done about it."""
    if sys.platform == "win32":  # it has none: the kernel clears up
        return
    from multiprocessing.resource_tracker import ensure_running

    old = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (old, "ignore:resource_tracker:UserWarning")))
    try:
        ensure_running()
    finally:
        if old is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = old


@contextmanager
def interrupts_for_parent() -> Iterator[None]:
    """Let children that are started here inherit a blocked Ctrl-C: a terminal sends it to all, the parent answers for them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    quiet_tracker()  # when it starts later, it unblocks the signal
    old, handler, held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}), signal.getsignal(signal.SIGINT), []
    # a library's thread may still take the signal: then, too, it waits until no child is half started
    waits = callable(handler) and threading.current_thread() is threading.main_thread()
    if waits:
        signal.signal(signal.SIGINT, lambda *_: held.append(True))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)
        if waits:
            signal.signal(signal.SIGINT, handler)
            if held:
                signal.raise_signal(signal.SIGINT)


@dataclass
class Batch:
    """A pool of children, used for all jobs of a run.

    Parameters
    ----------
    jobs : int
        Number of children.
    scratch : Path
        Folder for the event file.
    timeout_s : float, optional
        For a job of one shape; group tasks have no limit.
    memory_mb : int, optional
        Address space of a child.
    on_event : callable
        Called in the parent with every :class:`Event`.
    """

    jobs: int
    scratch: Path
    timeout_s: float | None = None
    memory_mb: int | None = None
    on_event: Callable[[Event], None] = lambda event: None
    peak_rss_mb: float = 0.0
    _pool: Any = field(default=None, init=False)
    _read: int = field(default=0, init=False)
    _steps: dict[str, str] = field(default_factory=dict, init=False)
    _warned: set[str] = field(default_factory=set, init=False)

    @property
    def events(self) -> Path:
        """The event file."""
        return self.scratch / "events.jsonl"

    def __enter__(self) -> Batch:
        return self

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        if self._pool is not None:
            if kind is None:
                self._pool.close()
            else:
                self._pool.stop()
            self._pool.join()

    def run(self, jobs: Sequence[Job], finished: Callable[[Job, Outcome], None]) -> None:
        """Run jobs, in the order given as far as children are free; call ``finished`` in the parent for each.

        Raises
        ------
        DiskError
            As soon as a child reports that it cannot write.
        ClusterLostError
            If a group task lost the cluster that shares its work.
        """
        if not jobs:
            return
        with one_thread_environment():
            if self._pool is None:
                from pebble import ProcessPool

                self.scratch.mkdir(parents=True, exist_ok=True)
                noise = str(self.scratch / "libraries.txt")
                quiet_tracker()
                self._pool = ProcessPool(
                    max_workers=self.jobs,
                    initializer=start_child,
                    initargs=(self.memory_mb, noise, os.getpid(), self.events),
                    context=multiprocessing.get_context("spawn"),
                )
            with interrupts_for_parent():
                waiting = {
                    self._pool.schedule(
                        run_job,
                        args=(job, self.events, self.memory_mb),
                        timeout=self._limit(job),
                    ): job
                    for job in jobs
                }
            while waiting:
                ready = [future for future in waiting if future.done()]
                self._listen()
                for future in ready:
                    job = waiting.pop(future)
                    outcome = self._outcome(job, future)
                    if outcome.disk:
                        for other in waiting:
                            other.cancel()
                        raise DiskError(errno.EIO, outcome.disk)
                    if outcome.lost:
                        raise ClusterLostError(outcome.lost)
                    finished(job, outcome)
                self._watch_memory()
                if not ready:
                    time.sleep(0.05)

    def _limit(self, job: Job) -> float | None:
        return (job.timeout_s or self.timeout_s) if job.shape is not None else None

    def _outcome(self, job: Job, future: Any) -> Outcome:
        from pebble import ProcessExpired

        stage = self._steps.get(job.key, job.steps[0] if job.steps else "")
        try:
            return future.result()
        except FutureTimeout:
            fact = f"did not finish within {self._limit(job):g} s"
            remedy = "raise limits.timeout_s, or check the scan in a mesh viewer"
        except ProcessExpired as error:
            fact, remedy = f"the process crashed ({_exit_text(error.exitcode)})", "check the scan in a mesh viewer"
            if error.exitcode == -9:
                remedy = "the system may have run out of memory: use fewer --jobs, or decimate more"
        except (SsmpipeError, Exception) as error:
            return Outcome((), _failure(job, stage, error, self.memory_mb))
        return Outcome((), record_failure(job, stage, fact, remedy, "", internal=job.shape is None))

    def _listen(self) -> None:
        try:
            with self.events.open("rb") as file:
                file.seek(self._read)
                data = file.read()
        except FileNotFoundError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        for line in whole.splitlines():
            try:
                event = Event(*json.loads(line))
            except (ValueError, TypeError):  # where workers of several machines write, lines may mix
                continue
            if event.kind == "start":
                self._steps[event.key] = event.step
            if event.kind == "warning":  # every child says it, one line is enough
                if event.text in self._warned:
                    continue
                self._warned.add(event.text)
            self.on_event(event)

    def _watch_memory(self) -> None:
        """Note the largest resident memory of parent and children together [MB], on Linux."""
        if not hasattr(os, "sysconf"):  # Windows
            return
        total = 0
        for pid in (os.getpid(), *(child.pid for child in multiprocessing.active_children())):
            try:
                total += int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            except (OSError, ValueError, IndexError):
                continue
        if total:
            self.peak_rss_mb = max(self.peak_rss_mb, total * os.sysconf("SC_PAGE_SIZE") / 2**20)


def _exit_text(code: int) -> str:
    if code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:
            return f"signal {-code}"
    return f"exit code {code}"
