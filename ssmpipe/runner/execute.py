"""Run one task: load, run, check, write aside, manifest last, rename. The only place where a stage is called in a run.

A reader never sees half an output: files are written into a scratch folder on the same disk, flushed, and the folder is
renamed into place with its manifest in it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.contract import Context, Port, Stage
from ssmpipe.core.checkpoints import Checkpoints
from ssmpipe.core.engine import Engine
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.io.codecs import load_artifact, save_artifact, to_plain
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.outlines import read_outline
from ssmpipe.report.units import unit_key
from ssmpipe.runner.chain import read_chain
from ssmpipe.runner.checkpoint import CheckpointFile, Found
from ssmpipe.runner.disk import disk_errors, flush
from ssmpipe.runner.fingerprint import VOLATILE, file_digest
from ssmpipe.runner.manifest import FILE, Manifest, Output
from ssmpipe.runner.plan import CHAIN, SCAN, PlannedStep, Producer
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import Source
from ssmpipe.runner.workspace import Workspace

TIMING = "timing.json"
LOG = "log.txt"
Progress = Callable[[int, int, str], None]


class StageContractError(Exception):
    """A stage broke its declaration: a programming error."""


@dataclass(frozen=True)
class TaskRecord:
    """What became of one task; ``shape`` is None for group tasks."""

    step: str
    shape: str | None
    status: str
    reason: str
    fingerprint: str = ""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    peak_rss_mb: float | None = None


@lru_cache
def versions() -> dict[str, str]:
    """Return the versions of what computes the numbers."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version()}
    for name in ("ssmpipe", "numpy", "scipy", "libigl", "trimesh"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def make_rng(seed: int, shape: str | None, step: str) -> np.random.Generator:
    """Return the generator of a task: a function of seed, shape and step, of nothing else."""
    key = hashlib.sha256(json.dumps([seed, shape, step]).encode()).digest()
    return np.random.default_rng(np.frombuffer(key, dtype=np.uint32))


def named_by_unit(metrics: dict[str, Any], unit: str) -> dict[str, Any]:
    """Return metrics whose names say the unit that their lengths have.

    Examples
    --------
    >>> named_by_unit({"rms_mm": 1.5, "area_mm2": 2.0, "n_faces": 3}, "file units")
    {'rms_unit': 1.5, 'area_unit2': 2.0, 'n_faces': 3}
    """
    return metrics if unit == "mm" else {unit_key(name): value for name, value in metrics.items()}


def run_task(
    workspace: Workspace,
    step: PlannedStep,
    shape: str | None,
    ids: Sequence[str] = (),
    *,
    force: bool = False,
    prepare: bool = False,
    progress: Progress | None = None,
    scans: dict[str, dict[str, Any]] | None = None,
    started: Callable[[], None] | None = None,
    checkpoint_every: int | None = None,
    engine: Engine | None = None,
    threads: int = 1,
) -> TaskRecord:
    """Run a task if it has to be run.

    Parameters
    ----------
    workspace : Workspace
    step : PlannedStep
    shape : str or None
        None for a group stage, and for a preparation.
    ids : sequence of str
        The shapes that a group stage or a preparation gets.
    force : bool
        Run although it is up to date.
    prepare : bool
        Run the stage's ``prepare`` instead of its ``run``.
    progress : callable, optional
    scans : dict, optional
        Scans read so far, filled here.
    started : callable, optional
        Called when it is clear that the task has to run.
    checkpoint_every : int, optional
        Iterations between two states that a group stage saves; without it none is saved.
    engine : Engine, optional
        Processes that share a group stage.
    threads : int
        That a group stage may use.

    Raises
    ------
    SsmpipeError
        If the stage refuses its input.
    DiskError
        If the output cannot be written.
    """
    workspace.forget()
    request = workspace.request(step, shape, ids, prepare=prepare)
    decision = workspace.decision(step, shape, ids, prepare=prepare, force=force)
    folder = workspace.prepared_folder(step) if prepare else workspace.folder(step, shape)
    if not decision.run:
        old = workspace.manifest(folder)
        if old is None:
            raise AssertionError("up to date without a manifest")
        return TaskRecord(step.id, shape, "up to date", decision.reason, request.fingerprint, old.metrics, old.warnings)
    if started is not None:
        started()
    begin, clock = time.time(), time.perf_counter()
    saved = CheckpointFile(workspace.out, step.id, request, versions())
    every = checkpoint_every if shape is None and not prepare else None
    found = saved.find(force=force) if every is not None else Found()
    _reset_peak()
    with _scratch(workspace.scratch, f"{shape or 'cohort'}-{step.folder}") as aside:
        with _logger(aside / LOG, f"{shape or 'cohort'}/{step.id}") as log:
            ctx = Context(shape_id=shape or "", rng=make_rng(workspace.seed, shape, step.id), log=log)
            if progress is not None:
                ctx.progress = progress
            ctx.engine, ctx.threads, ctx.unit, ctx.joins = engine, threads, workspace.unit, workspace.joins
            if every is not None:
                ctx.checkpoints = Checkpoints(saved.save, every, found.state)
            stage = workspace.registry.load(step.stage).suiting([s for s, p in step.inputs.items() if p is not None])
            cfg = stage.config.model_validate_json(json.dumps(_stage_options(step)))
            artifacts = _inputs(
                workspace, step, shape, ids, prepare=prepare, ctx=ctx, scans={} if scans is None else scans
            )
            ports = stage.prepared if prepare else stage.outputs
            made = _call(stage, artifacts, cfg, ctx, prepare=prepare)
            _check_made(stage, ports, made)
            log.info("finished")
        metrics = named_by_unit(to_plain(ctx.metrics), ctx.unit)
        timing = {key: value for key, value in metrics.items() if key.endswith("_s")}
        metrics = {key: value for key, value in metrics.items() if key not in timing}
        manifest = Manifest(
            step=step.id,
            request=request,
            outputs=_write(ports, made, aside),
            reason=decision.reason,
            metrics=metrics,
            warnings=tuple(ctx.warnings),
            versions=versions(),
            origins={slot: _origin(workspace, p, shape) for slot, p in step.inputs.items() if p is not None},
        )
        seconds, peak = time.perf_counter() - clock, peak_rss_mb()
        record = {"start": _iso(begin), "seconds": round(seconds, 3), "peak_rss_mb": peak, **timing}
        if found.line:
            record["checkpoint"] = found.line
        with disk_errors():
            (aside / TIMING).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            manifest.write(aside / FILE)
            publish(aside, folder)
    if shape is None and not prepare:
        saved.remove()
    workspace.forget()
    return TaskRecord(
        step.id, shape, "done", decision.reason, request.fingerprint, metrics, tuple(ctx.warnings), seconds, peak
    )


def rehearse(
    source: Source, steps: Sequence[PlannedStep], registry: Registry, seed: int
) -> tuple[str, SsmpipeError] | None:
    """Take one scan through per-shape steps in memory, as a run would, and write nothing.

    Parameters
    ----------
    source : Source
    steps : sequence of PlannedStep
        From the first of the chain on; none of them may need what is prepared from other shapes.
    registry : Registry
    seed : int

    Returns
    -------
    tuple of (str, SsmpipeError) or None
        The step that refuses the shape, and why; None when all accept it.
    """
    log = logging.Logger("check")
    log.addHandler(logging.NullHandler())
    made: dict[str, dict[str, Any]] = {SCAN: source.load()}
    for step in steps:
        stage = registry.load(step.stage).suiting([s for s, p in step.inputs.items() if p is not None])
        cfg = stage.config.model_validate_json(json.dumps(_stage_options(step)))
        artifacts = {s: None if p is None else made[p.step].get(s) for s, p in step.inputs.items()}
        try:
            made[step.id] = _call(
                stage, artifacts, cfg, Context(source.id, make_rng(seed, source.id, step.id), log), prepare=False
            )
        except SsmpipeError as error:
            return step.id, error
    return None


def _stage_options(step: PlannedStep) -> dict[str, Any]:
    return {key: step.files[key][1] if key in step.files else value for key, value in step.options.items()}


def _call(stage: Stage, artifacts: dict[str, Any], cfg: Any, ctx: Context, *, prepare: bool) -> dict[str, Any]:
    if not prepare:
        return stage.run(**artifacts, cfg=cfg, ctx=ctx)
    if stage.prepare is None:
        raise StageContractError(f"stage '{stage.name}' lists prepared slots but has no prepare function")
    return stage.prepare(artifacts, cfg=cfg, ctx=ctx)


def _check_made(stage: Stage, ports: Sequence[Port], made: Any) -> None:
    if not isinstance(made, Mapping):
        raise StageContractError(f"stage '{stage.name}' returned {type(made).__name__}, not a dict of artifacts")
    declared = {port.slot for port in ports}
    if set(made) - declared:
        raise StageContractError(f"stage '{stage.name}' made {sorted(set(made) - declared)}, which it does not declare")
    missing = sorted(port.slot for port in ports if made.get(port.slot) is None and not port.optional)
    if missing:
        raise StageContractError(f"stage '{stage.name}' did not make {missing}")


def _inputs(
    workspace: Workspace,
    step: PlannedStep,
    shape: str | None,
    ids: Sequence[str],
    *,
    prepare: bool,
    ctx: Context,
    scans: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    def one(slot: str, producer: Producer | None, member: str | None) -> Any:
        if producer is None:
            return None
        if producer.prepared and slot in step.files:
            path = Path(step.files[slot][1])
            return read_outline(path) if step.kinds[slot] == "outline" else read_mesh(path)
        if producer.step == SCAN:
            key = str(member)
            if key not in scans:
                scans[key] = workspace.sources[key].load()
                for warning in scans[key]["warnings"]:
                    ctx.warn(warning if shape else f"{key}: {warning}")
            return scans[key][slot]
        if producer.step == CHAIN:
            return read_chain(workspace)
        folder, manifest = workspace.produced(producer, member)
        if manifest is None:
            raise AssertionError("digests were read from it a moment ago")
        output = manifest.outputs.get(slot)
        if output is None:
            return None
        return load_artifact(output.kind, slot, folder, list(output.files))

    if prepare:
        slots = {s: p for s, p in step.inputs.items() if p is None or (not p.prepared and p.scope == "shape")}
        return {i: {slot: one(slot, producer, i) for slot, producer in slots.items()} for i in sorted(ids)}
    artifacts: dict[str, Any] = {}
    for slot, producer in step.inputs.items():
        if shape is None and producer is not None and producer.scope == "shape":
            artifacts[slot] = {i: one(slot, producer, i) for i in sorted(ids)}
        else:
            artifacts[slot] = one(slot, producer, shape)
    return artifacts


def _origin(workspace: Workspace, producer: Producer, shape: str | None) -> str:
    """Say where an input came from, without naming the machine's folders."""
    if producer.step == SCAN:
        return workspace.sources[shape].path.name if shape is not None else "scans"
    if producer.step == CHAIN:
        return CHAIN
    return producer.step + ("-prepare" if producer.prepared else "")


# --- files ---------------------------------------------------------------------------------------------------------


@contextmanager
def _scratch(parent: Path, name: str) -> Iterator[Path]:
    with disk_errors():
        parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=parent))
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _write(ports: Sequence[Port], made: Mapping[str, Any], folder: Path) -> dict[str, Output]:
    outputs = {}
    for port in ports:
        artifact = made.get(port.slot)
        if artifact is None:
            continue
        with disk_errors():
            files = save_artifact(port.kind, port.slot, artifact, folder)
            digests = {name: VOLATILE if port.volatile else file_digest(folder / name) for name in files}
            outputs[port.slot] = Output(port.kind, digests)
    return outputs


def publish(aside: Path, folder: Path) -> None:
    """Flush a finished folder to disk and rename it into place; what was there before is removed."""
    for path in aside.iterdir():
        flush(path)
    flush(aside)
    folder.parent.mkdir(parents=True, exist_ok=True)
    old = aside.with_name(aside.name + "-old")
    if folder.exists():
        os.rename(folder, old)
    aside.chmod(0o777 & ~_umask())  # mkdtemp made it private
    os.rename(aside, folder)
    flush(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


@lru_cache
def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextmanager
def _logger(path: Path, name: str) -> Iterator[logging.Logger]:
    """Log into the task's folder; no clock in it, so the log of a rerun is the same."""
    logger = logging.Logger(name, level=logging.DEBUG)
    with disk_errors():
        handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    logger.addHandler(handler)
    python = logging.getLogger("py.warnings")
    python.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield logger
    finally:
        logging.captureWarnings(False)
        python.removeHandler(handler)
        handler.close()


def _iso(seconds: float) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(seconds))


# --- memory --------------------------------------------------------------------------------------------------------


def _reset_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return  # elsewhere the peak of the whole process is reported


def peak_rss_mb() -> float | None:
    """Return the largest resident memory since the task began [MB], where the system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024, 1)
    try:
        import resource
    except ImportError:  # Windows
        return None
    in_bytes = sys.platform == "darwin"  # elsewhere in kB
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if in_bytes else 1024), 1)


def failure_of(error: BaseException, memory_mb: int | None = None) -> tuple[str, str, bool]:
    """Return (fact, remedy, internal) of whatever stopped a task."""
    if isinstance(error, SsmpipeError):
        return error.fact, error.remedy or "", False
    if isinstance(error, MemoryError):
        limit = f" (limits.memory_mb: {memory_mb})" if memory_mb else ""
        return f"ran out of memory{limit}", "decimate more, raise limits.memory_mb, or use fewer --jobs", False
    if isinstance(error, SystemExit):
        return f"a library ended the process (exit code {error.code})", "check the scan in a mesh viewer", False
    text = " ".join(str(error).split())[:200]
    return f"internal error {type(error).__name__}: {text}", "report it, with the traceback in failed.txt", True
