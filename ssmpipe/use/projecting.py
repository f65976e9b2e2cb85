"""Bring new scans into a model that stays as it is: the same chain, then coefficients, distances and meshes per patient."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ssmpipe.core.errors import ConfigError
from ssmpipe.io.codecs import read_json, write_json
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import MESH_SUFFIXES
from ssmpipe.io.tables import read_cohort, write_table
from ssmpipe.report.projected import INDEX
from ssmpipe.report.projected_index import build_index
from ssmpipe.runner.batch import Batch, Closing, Failure, Job, Outcome
from ssmpipe.runner.chain import chain_as_steps, read_content
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.exit_codes import OK
from ssmpipe.runner.lock import locked
from ssmpipe.runner.machine import default_jobs
from ssmpipe.runner.plan import Plan, make_plan
from ssmpipe.runner.record import write_failures
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import (
    IMAGE_SUFFIXES,
    OUTLINE_SUFFIXES,
    SPLINE_SUFFIX,
    Source,
    by_id,
    find_sources,
    scan_files,
)
from ssmpipe.runner.workspace import SCRATCH, Workspace
from ssmpipe.use.model import Model
from ssmpipe.use.projected_pages import index_of, page_path
from ssmpipe.use.projected_results import ProjectResult, exit_code_of, line_of, record_of, scores_table
from ssmpipe.use.projecting_shape import STEP, complete_shape, patient_folder, project_shape
from ssmpipe.use.target import Target


@dataclass(frozen=True)
class ProjectOptions:
    """What the command line says.

    Parameters
    ----------
    landmarks, cohort : Path, optional
        Named points per scan; a table with ``id`` and ``side``.
    side : {"L", "R", None}
        Of all scans that the table does not tell.
    jobs : int, optional
    timeout_s : float, optional
        For one scan.
    partial : bool
        Whether scans are fragments, which are completed instead of taken through the chain.
    fill : bool
        The same, and every fragment is also written with its openings filled.
    """

    landmarks: Path | None = None
    cohort: Path | None = None
    side: str | None = None
    jobs: int | None = None
    timeout_s: float | None = 3600.0
    partial: bool = False
    fill: bool = False


def project_scans(
    model: Model, scans: Sequence[Path], out: Path, options: ProjectOptions, console: Console
) -> ProjectResult:
    """Project scans into a model and write everything about them into ``out``.

    Every scan is a task of its own: what comes out for it depends on the scan and the model, not on the other scans.

    Raises
    ------
    ConfigError
        If the model carries no chain, or scans, tables or options do not fit.
    LockHeldError
        If another command writes into ``out``.
    DiskError
        If ``out`` cannot be written.
    """
    content = read_content(model.shape_model.chain, model.path.name)
    registry = Registry.default()
    sources, warnings = _sources(scans, content, options)
    if any(page_path(out, source.id) == out / INDEX for source in sources):
        raise ConfigError(
            f"'{Path(INDEX).stem}' cannot be the id of a patient, {INDEX} lists them all", "rename the scan"
        )
    kinds = sources[0].kinds
    if options.partial and (sources[0].kind != "mesh" or not len(model.shape_model.faces)):
        raise ConfigError("only surfaces can be completed", "leave out --partial and --fill")
    with locked(out):
        scratch = out / SCRATCH
        with disk_errors():
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir(parents=True)
            if options.partial or "surface" in kinds:
                plan = Plan(())
            else:
                assert model.shape_model.chain is not None
                steps, more = chain_as_steps(model.shape_model.chain, content, registry, out / "common", tuple(kinds))
                plan, warnings = make_plan(steps, kinds), [*warnings, *more]
        for warning in warnings:
            console.warn(warning)
        return _run(model, sources, plan, out, content, options, console, registry)


def _run(
    model: Model,
    sources: Sequence[Source],
    plan: Plan,
    out: Path,
    content: Mapping[str, Any],
    options: ProjectOptions,
    console: Console,
    registry: Registry,
) -> ProjectResult:
    target = Target.of(model, content)
    by_shape = {source.id: source for source in sources}
    workspace = Workspace(out, plan, by_shape, int(content["seed"]), registry, out / SCRATCH, joins=True)
    names = tuple(step.id for step in plan.steps)
    closing = Closing(STEP, partial(project_shape, target))
    if options.partial:
        closing = Closing("complete", partial(complete_shape, target, content["steps"], options.fill))
    jobs = [Job(workspace.only([s.id]), names, s.id, (s.id,), closing=closing) for s in sources]
    result = ProjectResult(OK)
    may_be_a_part = not options.partial and sources[0].kind == "mesh" and len(model.shape_model.faces) > 0
    with disk_errors():
        for source in sources:  # what an earlier call wrote must not stay when this one fails
            shutil.rmtree(patient_folder(out, source.id), ignore_errors=True)
            page_path(out, source.id).unlink(missing_ok=True)

    def finished(job: Job, outcome: Outcome) -> None:
        for record in outcome.records:
            for warning in record.warnings if record.status == "done" else ():
                console.warn(f"{record.shape}, {record.step}: {warning}")
        if outcome.failure is not None:
            failure = outcome.failure
            if may_be_a_part:
                failure = _with_hint(failure, outcome)
            result.failures[failure.shape] = failure
            console.error(f"failed: {failure.line}")
            return
        told = [(record.step, text) for record in outcome.records for text in record.warnings]
        result.warnings[str(job.shape)] = told
        row = read_json(patient_folder(out, str(job.shape)) / "projection.json")
        result.rows[str(job.shape)] = row
        console.say(line_of(row, target.unit))

    batch = Batch(
        jobs=min(options.jobs or default_jobs(), len(jobs)),
        scratch=workspace.scratch,
        timeout_s=options.timeout_s,
        on_event=console.event,
    )
    with console, batch:
        console.begin("project", len(jobs) * (len(names) + 1))
        batch.run(jobs, finished)
    failures = {
        i: {"stage": f.stage, "file": f.file, "error": f.error, "remedy": f.remedy} for i, f in result.failures.items()
    }
    with disk_errors():
        write_failures(out, failures)
        write_table(out / "scores.csv", scores_table(result.rows, len(target.model.variances), target.unit))
        write_json(out / "project.json", record_of(model, target, sources, result))
        write_atomically(out / INDEX, build_index(index_of(out, target, sources, result, failures)))
        shutil.rmtree(workspace.scratch, ignore_errors=True)
    result.exit_code = exit_code_of(result)
    return result


def _with_hint(failure: Failure, outcome: Outcome) -> Failure:
    """Return the failure with the remedy for a fragment: the file could be read, and the stages made nothing of it.

    Examples
    --------
    >>> small = Failure("a", "orient", "a.ply", "bounding box diagonal is 60 mm, femur-distal expects 90-700 mm", "check the file")
    >>> _with_hint(small, Outcome(())).remedy
    'check the file; if it shows a part only: --partial'
    """
    was_read = bool(outcome.records) or "bounding box" in failure.error
    if failure.internal or not was_read:
        return failure
    return replace(failure, remedy="; ".join(x for x in (failure.remedy, "if it shows a part only: --partial") if x))


def _sources(
    scans: Sequence[Path], content: Mapping[str, Any], options: ProjectOptions
) -> tuple[list[Source], list[str]]:
    try:
        found = scan_files(list(scans), (*MESH_SUFFIXES, *OUTLINE_SUFFIXES, *IMAGE_SUFFIXES, SPLINE_SUFFIX))
    except ConfigError as error:
        raise ConfigError(error.fact, "check the path") from None
    files = by_id(found)
    marks = None
    if options.landmarks is not None:
        marks = dict(read_landmarks(options.landmarks))
        if len(files) == len(marks) == 1:
            marks = dict(zip(files, marks.values(), strict=True))
        missing = sorted(set(files) - set(marks))
        if missing and len(missing) == len(files):
            raise ConfigError(
                f"{options.landmarks} has no entry '{missing[0]}'", f"it has: {', '.join(sorted(marks)[:5])}"
            )
    rows = dict(read_cohort(options.cohort)) if options.cohort is not None else {}
    rows = {i: {"side": options.side or "", **rows.get(i, {})} for i in files}
    diagonal = content.get("diagonal_mm")
    if diagonal and options.partial:
        diagonal = (0.0, diagonal[1])  # a part may be small
    sources, warnings = find_sources(
        files,
        cohort=rows,
        landmarks=marks,
        units=content["units"],
        roles=dict(content.get("roles") or {}),
        diagonal_mm=tuple(diagonal) if diagonal else None,
        anatomy=content.get("anatomy") or "",
        tolerance_mm=float(content.get("tolerance_mm", 20.0)),
    )
    mixed = sorted({s.kind for s in sources})
    if len(mixed) > 1:
        raise ConfigError(f"{' and '.join(mixed)} files cannot be projected together", "use one call for each kind")
    if mixed[0] not in (content.get("kind"), "spline"):
        raise ConfigError(
            f"the model was built from {content.get('kind')} files, {sources[0].path.name} is of the kind {mixed[0]}",
            "give scans of the same kind",
        )
    return sources, warnings
