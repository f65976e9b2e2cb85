"""Pages of single shapes, each written in a child process: what crashes or hangs there costs that page, not the report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmpipe.io.codecs import load_artifact
from ssmpipe.runner.batch import Batch, Closing, Failure, Job, Outcome
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.fingerprint import digest, file_digest
from ssmpipe.runner.machine import default_jobs
from ssmpipe.runner.patients import FOLDER, PAGES, WrittenPages, landmarks_of, page_name, steps_of
from ssmpipe.runner.plan import PlannedStep
from ssmpipe.runner.project import Project
from ssmpipe.runner.registry import REPORT
from ssmpipe.runner.workspace import SCRATCH, Workspace, make_workspace

if TYPE_CHECKING:
    from ssmpipe.report.patient import PatientPage
    from ssmpipe.report.pseudonyms import Pseudonyms

_FAILED_SHAPE_S = 60.0
"""A scan that failed is read once more for its picture; this long, since it may be what hangs [s]."""


@dataclass(frozen=True)
class PageWork:
    """What all pages have in common, for the children: they read it from disk, once each.

    Parameters
    ----------
    folder : Path
        Where the pages go.
    record : Path
        JSON file: the record of the run as the report shows it, and the neutral names, if any.
    token : str
        Digest of the record and of the results; a child keeps what it has read while this stays.
    bare : bool
        Leave out what is read from the folders of the shape: for a page that could not be made with them.
    """

    folder: Path
    record: Path
    token: str
    bare: bool = False


def results_of(workspace: Workspace, step: PlannedStep) -> dict[str, Any]:
    """Return the results of the group stages that the report shows, by slot; None for what there is not."""
    artifacts: dict[str, Any] = {}
    for slot, producer in step.inputs.items():
        if producer is not None and producer.scope == "shape":
            continue
        artifacts[slot] = None
        if producer is not None:
            where, manifest = workspace.produced(producer, None)
            output = manifest.outputs.get(slot) if manifest else None
            artifacts[slot] = load_artifact(output.kind, slot, where, list(output.files)) if output else None
    return artifacts


def shape_page(
    shape: str, shown: Mapping[str, Any], artifacts: Mapping[str, Any], workspace: Workspace, *, bare: bool = False
) -> PatientPage:
    """Return what the page of one shape shows; ``bare``: without what is read from the folders of the shape."""
    from ssmpipe.report.patient import PatientPage

    ids = sorted(shown["shapes"])
    place = ids.index(shape)
    correspondence = artifacts["correspondence"]
    marks = {} if bare else landmarks_of(workspace.only([shape]), report_step(workspace), correspondence)
    return PatientPage(
        id=shape,
        record=shown,
        steps=[] if bare else steps_of(workspace, shape, shown["shapes"][shape], correspondence),
        correspondence=correspondence,
        model=artifacts["model"],
        certificate=artifacts["certificate"],
        quality=artifacts["quality"],
        reconstructions=artifacts["reconstructions"],
        landmarks=marks.get(shape, {}),
        before=ids[place - 1] if place else None,
        after=ids[place + 1] if place + 1 < len(ids) else None,
    )


def report_step(workspace: Workspace) -> PlannedStep:
    """Return the step that writes the report."""
    return next(step for step in workspace.plan.steps if step.stage == REPORT)


def make_page(work: PageWork, workspace: Workspace, shape: str) -> list[str]:
    """Write the page of one shape; called in a child process."""
    from ssmpipe.report.patient import build_patient

    common = _common(replace(work, bare=False), workspace)
    page = shape_page(shape, common.shown, common.results, workspace, bare=work.bare)
    if common.names is not None:
        page = page.renamed(common.names, common.hidden, common.renamed)
    write_atomically(work.folder / page_name(page.id), build_patient(page))
    return []


@dataclass(frozen=True, eq=False)
class _Common:
    shown: Mapping[str, Any]
    results: Mapping[str, Any]
    names: Pseudonyms | None = None
    hidden: Mapping[str, Any] = field(default_factory=dict)
    renamed: Mapping[str, Any] = field(default_factory=dict)


_KEPT: dict[PageWork, _Common] = {}


def _common(work: PageWork, workspace: Workspace) -> _Common:
    """Return what all pages show, read once by every child."""
    if work not in _KEPT:
        from ssmpipe.report.pseudonyms import Pseudonyms

        given = json.loads(work.record.read_text(encoding="utf-8"))
        results = results_of(workspace, report_step(workspace))
        _KEPT.clear()
        _KEPT[work] = _Common(given["shown"], results)
        if given["names"] is not None:
            words = tuple((a, b) for a, b in given["names"]["words"])
            names = Pseudonyms(given["names"]["names"], given["names"]["subjects"], words)
            _KEPT[work] = _Common(given["shown"], results, names, names.record(given["shown"]), names.results(results))
    return _KEPT[work]


def make_pages(
    batch: Batch,
    workspace: Workspace,
    shapes: list[str],
    shown: Mapping[str, Any],
    folder: Path,
    warn: Callable[[str], None],
    names: Pseudonyms | None = None,
) -> set[str]:
    """Write the pages of shapes in the children of ``batch``; return the shapes whose page could not be written.

    A page that cannot be made is made once more without pictures of the stages. Either way one line, given to ``warn``, names the
    shape and the reason; the other pages do not notice.

    Raises
    ------
    DiskError
        If a child cannot write.
    """
    if not shapes:
        return set()
    told = None if names is None else {"names": names.names, "subjects": names.subjects, "words": names.words}
    text = json.dumps({"shown": shown, "names": told})
    step = report_step(workspace)
    made = [
        workspace.slot_digest(producer, slot, None)
        for slot, producer in sorted(step.inputs.items())
        if producer is not None and producer.scope == "cohort"
    ]
    record = workspace.scratch / "report.json"
    write_atomically(record, text, mode=None if names is None else 0o600)  # it says who is who
    work = PageWork(folder, record, digest([text, made]))
    failed: dict[str, Failure] = {}

    def finished(job: Job, outcome: Outcome) -> None:
        if outcome.failure is not None:
            failed[str(job.shape)] = outcome.failure

    def jobs(ids: list[str], work: PageWork) -> list[Job]:
        closing = Closing(REPORT, partial(make_page, work))
        set_aside = shown.get("failures") or {}
        return [
            Job(
                workspace.only([i]), (), i, (i,), closing=closing, aside=True,
                timeout_s=_FAILED_SHAPE_S if i in set_aside else None,
            )
            for i in ids
        ]  # fmt: skip

    with disk_errors():
        folder.mkdir(parents=True, exist_ok=True)
    batch.run(jobs(shapes, work), finished)
    first, failed = failed, {}
    batch.run(jobs(sorted(first), replace(work, bare=True)), finished)
    for shape, why in sorted(first.items()):
        what = "its page could not be made" if shape in failed else "its page has no pictures of the stages"
        warn(f"{shape}, {why.file}: {what}: {why.error}" + (f"; try: {why.remedy}" if why.remedy else ""))
    with disk_errors():
        for shape in failed:
            (folder / page_name(shape if names is None else names.names[shape])).unlink(missing_ok=True)
    return set(failed)


def write_pages(
    workspace: Workspace,
    step: PlannedStep,
    shown: Mapping[str, Any],
    requests: Mapping[str, str],
    batch: Batch,
    warn: Callable[[str], None],
    *,
    force: bool = False,
) -> dict[str, str]:
    """Write the pages that are not up to date, remove those of shapes that are gone; return the digest of every page.

    A shape whose page could not be written is not among them, and is tried again the next time.
    """
    folder, pages = workspace.folder(step, None), workspace.out / FOLDER
    old = WrittenPages.read(folder)
    stale = [i for i, request in requests.items() if force or not old.current(i, request, pages / page_name(i))]
    failed = make_pages(batch, workspace, stale, shown, pages, warn)
    files = {i: file_digest(pages / page_name(i)) for i in requests if i not in failed}
    with disk_errors():
        for shape in set(old.files) - set(files):
            (pages / page_name(shape)).unlink(missing_ok=True)
    kept = {i: request for i, request in requests.items() if i in files}
    write_atomically(folder / PAGES, WrittenPages(kept, files).text())
    return files


@contextmanager
def pages_batch(project: Project, scratch: Path, jobs: int | None, console: Console) -> Iterator[Batch]:
    """Yield children of this machine for the pages of shapes, with the limits of the config."""
    limits = project.config.limits
    with Batch(
        jobs=min(jobs or default_jobs(), max(1, len(project.sources))),
        scratch=scratch,
        timeout_s=limits.timeout_s,
        memory_mb=limits.memory_mb,
        on_event=console.event,
    ) as batch:
        yield batch


@contextmanager
def for_report(project: Project, jobs: int | None, console: Console) -> Iterator[tuple[Workspace, Batch]]:
    """Yield workspace and children of a command that writes the report alone; their scratch folder goes afterwards."""
    scratch = project.out / SCRATCH / "report"
    try:
        with pages_batch(project, scratch, jobs, console) as batch:
            yield replace(make_workspace(project), scratch=scratch), batch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        with suppress(OSError):
            scratch.parent.rmdir()  # unless a run left something there
