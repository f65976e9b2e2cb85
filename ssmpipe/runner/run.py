"""A whole run: segments of the chain in order, failures set aside, records written, exit code decided."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ssmpipe.core.errors import ConfigError, SsmpipeError
from ssmpipe.runner.batch import COHORT, Batch, ClusterAddress, Failure, Job, Outcome
from ssmpipe.runner.checkpoint import CheckpointFile
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import DiskError, disk_errors, write_atomically
from ssmpipe.runner.execute import TaskRecord, versions
from ssmpipe.runner.exit_codes import INTERNAL, OK, QUARANTINED
from ssmpipe.runner.lock import locked
from ssmpipe.runner.machine import default_jobs, machine
from ssmpipe.runner.pages import pages_batch
from ssmpipe.runner.plan import CHAIN, SCAN, PlannedStep, segments
from ssmpipe.runner.project import Project
from ssmpipe.runner.record import read_failures, run_record, write_failures
from ssmpipe.runner.registry import REPORT
from ssmpipe.runner.run_options import RunOptions, scheduler_of
from ssmpipe.runner.selection import Selection, make_selection
from ssmpipe.runner.shortage import shortage
from ssmpipe.runner.suggest import count
from ssmpipe.runner.workspace import forecast, make_workspace, prepare_members


@dataclass
class RunResult:
    """What came out: exit code, shapes that went through, failures, and the report when there is one."""

    exit_code: int
    ok: list[str]
    failures: dict[str, Failure]
    report: Path | None
    seconds: float
    n_run: int = 0
    n_current: int = 0
    problem: str = ""


def run_project(project: Project, options: RunOptions, console: Console) -> RunResult:
    """Run a project.

    Raises
    ------
    ConfigError
        If the options cannot be followed.
    LockHeldError
        If another run holds the output folder.
    DiskError
        If the output cannot be written.
    ClusterLostError
        If no worker of a cluster is left.
    """
    chosen = make_selection(project, options)
    scheduler = scheduler_of(project.config, options)
    if scheduler is not None:
        from ssmpipe.runner.cluster import require_dask

        require_dask(scheduler == "slurm")
    part = f"{options.part[0]}-of-{options.part[1]}" if options.part else None
    with locked(project.out, part):
        return _Run(project, options, chosen, console).go()


@dataclass
class _Run:
    """State of a run in the parent process."""

    project: Project
    options: RunOptions
    chosen: Selection
    console: Console
    failures: dict[str, Failure] = field(default_factory=dict)
    records: dict[tuple[str, str | None], TaskRecord] = field(default_factory=dict)
    problem: str = ""
    exit_code: int = OK

    def go(self) -> RunResult:
        """Run all segments and write the records."""
        begin, clock = time.time(), time.perf_counter()
        self.workspace = make_workspace(self.project, self.options.part)
        self._tidy()
        self.earlier = read_failures(self.project.out)
        for warning in self.project.warnings:
            self.console.warn(warning)
        if self.chosen.dropped:
            self.console.say(
                f"not all shapes are selected, so group stages are left out: {', '.join(self.chosen.dropped)}"
            )
        jobs = self.jobs = self.options.jobs or default_jobs()
        report: Path | None = None
        try:
            with self.console, self._batch(jobs) as batch:
                self.alive = list(self._start_shapes())
                for kind, steps in segments(self.chosen.steps):
                    if kind == "shape":
                        self._shapes(batch, steps)
                    elif kind == "prepare":
                        self._prepare(batch, steps[0])
                    elif steps[0].stage != REPORT:
                        self._cohort(batch, steps[0])
                    if self.problem:
                        break
                if any(step.stage == REPORT for step in self.chosen.steps) and not self.problem:
                    report = self._report(batch, jobs)
        finally:
            self._write_failures()
        seconds = time.perf_counter() - clock
        totals = {
            "start": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(begin)),
            "seconds": round(seconds, 3),
            "jobs": jobs,
            "peak_rss_mb": round(batch.peak_rss_mb, 1),
        }
        self._write_run(totals)
        ok = [i for i in self.chosen.shapes if i not in self.failures]
        unproved = any(record.metrics.get("unproved") for record in self.records.values())
        if (self.failures or unproved) and self.exit_code == OK:
            self.exit_code = QUARANTINED
        if self.exit_code == OK:
            shutil.rmtree(self.workspace.scratch, ignore_errors=True)
        return RunResult(
            exit_code=self.exit_code,
            ok=ok,
            failures=self.failures,
            report=report,
            seconds=time.perf_counter() - clock,
            n_run=sum(r.status == "done" for r in self.records.values()),
            n_current=sum(r.status == "up to date" for r in self.records.values()),
            problem=self.problem,
        )

    @contextmanager
    def _batch(self, jobs: int) -> Iterator[Batch]:
        """Yield what runs jobs: children of this process, or workers of a cluster."""
        config = self.project.config
        shared: dict[str, Any] = {
            "scratch": self.workspace.scratch,
            "timeout_s": config.limits.timeout_s,
            "memory_mb": config.limits.memory_mb,
            "on_event": self.console.event,
        }
        scheduler = scheduler_of(config, self.options)
        if scheduler is None:
            with Batch(jobs=min(jobs, max(1, len(self.chosen.shapes))), **shared) as batch:
                yield batch
            return
        from ssmpipe.runner.cluster import DaskBatch, open_cluster

        base, folder = self.project.path.parent, self.workspace.scratch / "dask"
        with open_cluster(config, scheduler, jobs, folder, base) as client:
            wait_s = config.limits.worker_wait_s
            address = ClusterAddress(client.scheduler.address, client.security, scheduler == "local", wait_s)
            self.console.say(f"dask: {client.scheduler.address}, {len(client.nthreads())} workers so far")
            queued = scheduler == "slurm"
            with DaskBatch(
                jobs=1, client=client, address=address, worker_wait_s=wait_s, queued=queued, **shared
            ) as batch:
                yield batch

    def _tidy(self) -> None:
        """Sweep what a killed run left behind; give folders their new number when the chain was changed."""
        with disk_errors():
            shutil.rmtree(self.workspace.scratch, ignore_errors=True)
            self.workspace.scratch.mkdir(parents=True)
            for shape in self.chosen.shapes:
                home = self.project.out / "shapes" / shape
                for step in self.project.plan.steps:
                    if step.scope == "shape" and not (home / step.folder).exists():
                        old = sorted(home.glob(f"[0-9][0-9]-{step.id}"))
                        if len(old) == 1:
                            old[0].rename(home / step.folder)
            cohort = self.project.out / "cohort"
            for step in self.project.plan.steps:
                target = self.workspace.prepared_folder(step)
                if step.prepares and not target.exists():
                    old = sorted(cohort.glob(f"[0-9][0-9]-{step.id}-prepare"))
                    if len(old) == 1:
                        old[0].rename(target)

    def _start_shapes(self) -> Sequence[str]:
        """Return the shapes to begin with: those selected, and those that a preparation needs besides."""
        wanted = set(self.chosen.shapes)
        for step in self.chosen.steps:
            if not (self.chosen.partial and step.prepares) or self.workspace.prepared_is_usable(step):
                continue
            wanted |= set(prepare_members(step, sorted(self.project.sources)))
        # a part begins with its own shapes: when it comes to the others, their parts have mostly done them
        return sorted(wanted, key=lambda shape: (shape not in self.chosen.shapes, shape))

    def _lock(self, key: str) -> Path | None:
        """Return what parts of a run lock while they work on a shape, or on what is common to all."""
        if self.options.part is None:
            return None
        folder = self.project.out / ".locks"
        with disk_errors():
            folder.mkdir(exist_ok=True)
        return folder / key

    # --- segments ---

    def _shapes(self, batch: Batch, steps: list[PlannedStep]) -> None:
        wanted = [i for i in self.alive if i not in self.failures and not self._blocked(i, steps[0])]
        wanted = self._with_inputs(steps, wanted)
        self.workspace.forget()
        ready = {step.id for step in steps}
        plans = forecast(self.workspace, steps, wanted, self.chosen.forced, ready)
        busy = {f.shape for f in plans if f.run}
        for item in plans:
            if item.shape not in busy:
                self._note_current(item.step, item.shape)
        names = tuple(step.id for step in steps)
        text = names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"
        current = len(wanted) - len(busy)
        if current:
            self.console.say(f"{text}: {current} of {len(wanted)} shapes are up to date")
        jobs = [
            Job(
                self.workspace.only([shape]),
                names,
                shape,
                (shape,),
                self.chosen.forced & set(names),
                lock=self._lock(f"shape-{shape}"),
            )
            for shape in wanted
            if shape in busy
        ]
        self.console.begin(text, len(jobs) * len(names))
        for job in jobs:
            for item in plans:
                if item.shape == job.shape and item.run:
                    self.console.say(f"  {item.shape} {item.step}: {item.reason}", level=2)
        done = [0]

        def finished(job: Job, outcome: Outcome) -> None:
            done[0] += 1
            self._take(outcome)
            seconds = sum(r.seconds for r in outcome.records)
            n_run = sum(r.status == "done" for r in outcome.records)
            if outcome.failure is None:
                self.console.say(f"[{done[0]}/{len(jobs)}] {job.shape}: {count(n_run, 'stage')} run, {seconds:.1f} s")

        batch.run(jobs, finished)
        self.workspace.forget()

    def _blocked(self, shape: str, step: PlannedStep) -> bool:
        """Whether a shape failed in an earlier run before ``step``, in a stage that this run does not repeat."""
        stage = self.earlier.get(shape, {}).get("stage")
        before = [s.id for s in self.project.plan.steps if s.number < step.number and s not in self.chosen.steps]
        return stage in before

    def _with_inputs(self, steps: list[PlannedStep], ids: list[str]) -> list[str]:
        """Leave out shapes whose inputs from outside this run do not exist; refuse when that leaves none."""
        inside = {step.id for step in self.chosen.steps}
        missing: dict[str, str] = {}
        for step in steps:
            for slot, producer in step.inputs.items():
                if producer is None or producer.step in (SCAN, CHAIN, *inside) or producer.prepared:
                    continue
                for shape in ids:
                    if self.workspace.produced(producer, shape)[1] is None:
                        missing.setdefault(shape, f"stage '{step.id}' needs '{slot}' of stage '{producer.step}'")
        if missing and len(missing) == len(ids):
            raise ConfigError(f"{next(iter(missing.values()))}, which has not been run", "leave out --only or --from")
        for shape, what in missing.items():
            if shape not in self.earlier:
                self.console.warn(f"{shape}: left out: {what}, which has not been run for it")
        return [i for i in ids if i not in missing]

    def _prepare(self, batch: Batch, step: PlannedStep) -> None:
        if self.chosen.partial and step.id not in self.chosen.forced and self.workspace.prepared_is_usable(step):
            self.alive = [i for i in self.alive if i in self.chosen.shapes]
            return
        everyone = sorted(self.project.sources)
        members = prepare_members(step, everyone)
        named = len(members) == 1 < len(everyone)
        gone = [i for i in members if i in self.failures or (i not in self.alive and i in self.earlier)]
        if named and gone:
            self._stop(
                f"'{step.id}': its reference shape {members[0]} failed; try: mend it, or name another one", QUARANTINED
            )
            return
        ids = [i for i in members if i not in gone]
        ids = self._with_inputs([step], ids)
        if not ids:
            self._stop(
                f"'{step.id}': no shape is left; try: mend the shapes that failed, each is named above with its remedy",
                QUARANTINED,
            )
            return
        self._group_job(
            batch,
            Job(
                self.workspace.only(ids),
                (step.id,),
                None,
                tuple(ids),
                self.chosen.forced,
                prepare=True,
                lock=self._lock(f"prepare-{step.id}"),
            ),
        )
        self.alive = [i for i in self.alive if i in self.chosen.shapes]

    def _cohort(self, batch: Batch, step: PlannedStep) -> None:
        everyone = sorted(self.project.sources)
        gone = self._remaining_failures()
        ids = [i for i in everyone if i not in gone]
        if any(p.scope == "shape" for p in step.upstream):
            ids = self._with_inputs([step], ids)
        short = shortage(self.project.config, len(ids), len(everyone))
        if short:
            self._stop(f"'{step.id}' was not run: {short}", QUARANTINED)
        else:
            every = self.project.config.limits.checkpoint_every
            only = self.workspace.only(ids)
            threads = 1 if scheduler_of(self.project.config, self.options) else self.jobs  # those of dask are workers
            job = Job(only, (step.id,), None, tuple(ids), self.chosen.forced, checkpoint_every=every, threads=threads)
            self._group_job(batch, job)

    def _group_job(self, batch: Batch, job: Job) -> None:
        step = self.project.plan.step(job.steps[0])
        self.workspace.forget()
        name = f"{step.id} (prepare)" if job.prepare else step.id
        try:
            decision = self.workspace.decision(
                step, None, job.ids, prepare=job.prepare, force=step.id in self.chosen.forced
            )
        except SsmpipeError as error:
            self._stop(f"{name}: {error}", QUARANTINED)
            return
        if not decision.run:
            if not job.prepare:
                self._note_current(step.id, "")
                self._checkpoint(step, job).remove()
            self.console.say(f"{name}: up to date")
            return
        self.console.begin(name, 1)
        self.console.say(f"  {name}: {decision.reason}", level=2)
        if not job.prepare and job.checkpoint_every is not None:
            found = self._checkpoint(step, job).find(force=step.id in self.chosen.forced)
            if found.line:
                self.console.say(f"{name}: {found.line}")

        def finished(job: Job, outcome: Outcome) -> None:
            self._take(outcome)
            if outcome.failure is not None:
                internal = outcome.failure.internal
                self._stop(outcome.failure.line, INTERNAL if internal else QUARANTINED, say=False)
            else:
                self.console.say(
                    f"{name}: {count(len(job.ids), 'shape')}, {sum(r.seconds for r in outcome.records):.1f} s"
                )

        batch.run([job], finished)
        self.workspace.forget()
        if job.prepare:
            self.records.pop((step.id, None), None)

    def _checkpoint(self, step: PlannedStep, job: Job) -> CheckpointFile:
        request = self.workspace.request(step, None, job.ids)
        return CheckpointFile(self.project.out, step.id, request, versions())

    # --- bookkeeping ---

    def _take(self, outcome: Outcome) -> None:
        for record in outcome.records:
            self.records[(record.step, record.shape)] = record
            for warning in record.warnings if record.status == "done" else ():
                self.console.warn(f"{record.shape or 'cohort'}, {record.step}: {warning}")
        if outcome.failure is not None:
            self.failures[outcome.failure.shape] = outcome.failure
            self.console.error(f"failed: {outcome.failure.line}")

    def _note_current(self, step: str, shape: str) -> None:
        planned = self.project.plan.step(step)
        folder = self.workspace.folder(planned, shape or None)
        manifest = self.workspace.manifest(folder)
        if manifest is not None:
            self.records[(step, shape or None)] = TaskRecord(
                step,
                shape or None,
                "up to date",
                "up to date",
                manifest.request.fingerprint,
                manifest.metrics,
                manifest.warnings,
            )

    def _stop(self, problem: str, exit_code: int, *, say: bool = True) -> None:
        self.problem, self.exit_code = problem, exit_code
        if say:
            self.console.error(problem)

    def _remaining_failures(self) -> dict[str, dict[str, str]]:
        """Failures of this run, and those of earlier runs for shapes that this run did not touch."""
        touched = {shape for (_, shape) in self.records if shape is not None}
        inside = {step.id for step in self.chosen.steps}
        kept = {
            key: value
            for key, value in self.earlier.items()
            if (key in self.project.sources and (key not in touched or value.get("stage") not in inside))
            or (key == COHORT and value.get("stage") not in inside)
        }
        now = {
            key: {"stage": f.stage, **({"file": f.file} if f.file else {}), "error": f.error, "remedy": f.remedy}
            for key, f in self.failures.items()
        }
        return {**kept, **now}

    def _write_failures(self) -> None:
        write_failures(self.project.out, self._remaining_failures(), parts=self.options.part is not None)

    def _write_run(self, totals: dict[str, Any]) -> None:
        record = run_record(self.project, self.workspace, self._remaining_failures(), self.records, totals, machine())
        name = (
            "run.json"
            if self.options.part is None
            else f"run.part-{self.options.part[0]}-of-{self.options.part[1]}.json"
        )
        write_atomically(self.project.out / name, json.dumps(record, indent=1, ensure_ascii=False) + "\n")

    def _report(self, batch: Batch, jobs: int) -> Path | None:
        from ssmpipe.runner.reporting import write_report

        step = next(s for s in self.chosen.steps if s.stage == REPORT)
        record = run_record(self.project, self.workspace, self._remaining_failures(), self.records, {}, machine())
        self.console.begin("report", len(self.project.sources))
        try:
            own = nullcontext(batch) if type(batch) is Batch else None  # workers of a cluster do not make pages
            with own or pages_batch(self.project, self.workspace.scratch, jobs, self.console) as here:
                path, task = write_report(
                    self.workspace, step, record, here, self.console.warn, force=step.id in self.chosen.forced
                )
        except DiskError:
            raise
        except SsmpipeError as error:
            self._stop(f"report: {error}", QUARANTINED)
            return None
        self.records[(step.id, None)] = task
        self.console.say(f"report: {'up to date' if task.status == 'up to date' else f'{task.seconds:.1f} s'}")
        return path
