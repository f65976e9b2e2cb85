"""The last stage: the record of the run and all results become ``report.html`` and a page per shape beside it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.batch import Batch
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.execute import TaskRecord, versions
from ssmpipe.runner.fingerprint import digest, file_digest
from ssmpipe.runner.manifest import FILE, Decision, Manifest, Output, Request, decide
from ssmpipe.runner.pages import results_of, write_pages
from ssmpipe.runner.patients import FOLDER, landmarks_of, page_digests, page_name
from ssmpipe.runner.plan import PlannedStep
from ssmpipe.runner.record import report_record
from ssmpipe.runner.workspace import Workspace

if TYPE_CHECKING:
    from ssmpipe.report.build import Document

NAME = "report.html"


class Config(StageConfig):
    """Options of ``report``: none yet."""


def run(*, cfg: Config, ctx: Context, **artifacts: Any) -> dict[str, Any]:
    """Refuse: the report needs the record of a run (``ssmpipe report CONFIG``)."""
    raise SsmpipeError("the report is made from a whole run", "ssmpipe report CONFIG.yaml")


STAGE = Stage(
    name="report",
    scope="cohort",
    version=5,  # shows landmarks that geometry proposes
    config=Config,
    run=run,
    inputs=(
        Port("correspondence", "correspondence"),
        Port("model", "model"),
        Port("measures", "table"),
        Port("landmark_transfer", "table", optional=True),
        Port("history", "table"),
        Port("certificate", "json"),
        Port("quality", "table", optional=True),
        Port("reconstructions", "arrays", optional=True),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform", optional=True),
    ),
    outputs=(Port("report", "html"),),
)


def _request(workspace: Workspace, step: PlannedStep, shown: dict[str, Any], pages: Mapping[str, str]) -> Request:
    inputs = {
        **workspace.input_digests(step, None, ()),
        "record": digest(shown),
        "shapes": digest(dict(pages)),
        "ssmpipe": digest(shown["ssmpipe_version"]),  # an input, not an option: a forecast knows the options alone
    }
    return Request(step.stage, step.version, dict(step.options), inputs, workspace.seed, None)


def report_decision(
    workspace: Workspace, step: PlannedStep, record: dict[str, Any], *, force: bool = False
) -> Decision:
    """Return whether the report would be written now, and why.

    Raises
    ------
    SsmpipeError
        If a result that it needs does not exist.
    """
    folder = workspace.folder(step, None)
    shown = report_record(record)
    request = _request(workspace, step, shown, page_digests(workspace, step, shown))
    return decide(workspace.manifest(folder), request, folder, force=force)


def write_report(
    workspace: Workspace,
    step: PlannedStep,
    record: dict[str, Any],
    batch: Batch,
    warn: Callable[[str], None],
    *,
    force: bool = False,
) -> tuple[Path, TaskRecord]:
    """Write ``report.html`` and the pages of the shapes, those whose content has changed, in the children of ``batch``.

    A page that cannot be made is told to ``warn``, is not linked, and is tried again the next time.

    Raises
    ------
    SsmpipeError
        If a result that it needs does not exist.
    DiskError
        If it cannot be written.
    """
    clock = time.perf_counter()
    shown = report_record(record)
    requests = page_digests(workspace, step, shown)
    request = _request(workspace, step, shown, requests)
    folder = workspace.folder(step, None)
    decision = decide(workspace.manifest(folder), request, folder, force=force)
    target = workspace.out / NAME
    if not decision.run:
        return target, TaskRecord(step.id, None, "up to date", decision.reason, request.fingerprint)
    artifacts = results_of(workspace, step)
    marks = landmarks_of(workspace, step, artifacts["correspondence"], warn)
    files = write_pages(workspace, step, shown, requests, batch, warn, force=force)
    addresses = {shape: f"{FOLDER}/{page_name(shape)}" for shape in files}
    if len(files) < len(requests):  # another request than the next one, which will try again
        request = _request(workspace, step, shown, {shape: requests[shape] for shape in files})
    write_atomically(target, report_of(shown, artifacts, marks, addresses).html())
    with disk_errors():
        folder.mkdir(parents=True, exist_ok=True)
        up = Path(os.pardir) / os.pardir
        written = {(up / NAME).as_posix(): file_digest(target)}
        written |= {(up / FOLDER / page_name(shape)).as_posix(): sha for shape, sha in files.items()}
        outputs = {"report": Output("html", written)}
        manifest = Manifest(step.id, request, outputs, decision.reason, {}, (), versions(), {})
        aside = folder / f".{FILE}"
        manifest.write(aside)
        os.replace(aside, folder / FILE)
    workspace.forget()
    return target, TaskRecord(
        step.id, None, "done", decision.reason, request.fingerprint, seconds=time.perf_counter() - clock
    )


def report_of(
    shown: Mapping[str, Any], artifacts: Mapping[str, Any], marks: Mapping[str, Any], pages: Mapping[str, str]
) -> Document:
    """Return the report before it is made into HTML or PDF; ``pages`` are addresses of the pages of the shapes."""
    from ssmpipe.report.build import report_document

    given = {slot: value for slot, value in artifacts.items() if slot != "reconstructions"}
    return report_document(record=shown, **given, landmarks=marks, pages=pages)
