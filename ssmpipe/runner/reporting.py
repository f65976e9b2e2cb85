"""The last stage: the record of the run and the results of the group stages become ``report.html``."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.errors import SsmpipeError
from ssmpipe.io.codecs import load_artifact
from ssmpipe.runner.config import Project
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.execute import TaskRecord, versions
from ssmpipe.runner.fingerprint import digest, file_digest
from ssmpipe.runner.manifest import FILE, Decision, Manifest, Output, Request, decide
from ssmpipe.runner.plan import PlannedStep
from ssmpipe.runner.record import report_record
from ssmpipe.runner.workspace import Workspace

NAME = "report.html"


class Config(StageConfig):
    """Options of ``report``: none yet."""


def run(*, cfg: Config, ctx: Context, **artifacts: Any) -> dict[str, Any]:
    """Refuse: the report needs the record of a run (``ssmpipe report CONFIG``)."""
    raise SsmpipeError("the report is made from a whole run", "ssmpipe report CONFIG.yaml")


STAGE = Stage(
    name="report",
    scope="cohort",
    version=1,
    config=Config,
    run=run,
    inputs=(
        Port("correspondence", "correspondence"),
        Port("model", "model"),
        Port("measures", "table"),
        Port("landmark_transfer", "table", optional=True),
        Port("history", "table"),
        Port("certificate", "json"),
    ),
    outputs=(Port("report", "html"),),
)


def _request(workspace: Workspace, step: PlannedStep, shown: dict[str, Any]) -> Request:
    inputs = {**workspace.input_digests(step, None, ()), "record": digest(shown)}
    config = {**dict(step.options), "ssmpipe": shown["ssmpipe_version"]}
    return Request(step.stage, step.version, config, inputs, workspace.seed, None)


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
    request = _request(workspace, step, report_record(record))
    return decide(workspace.manifest(folder), request, folder, force=force)


def write_report(
    project: Project, workspace: Workspace, step: PlannedStep, record: dict[str, Any], *, force: bool = False
) -> tuple[Path, TaskRecord]:
    """Write ``report.html`` if what it shows has changed.

    Raises
    ------
    SsmpipeError
        If a result that it needs does not exist.
    DiskError
        If it cannot be written.
    """
    clock = time.perf_counter()
    shown = report_record(record)
    request = _request(workspace, step, shown)
    folder = workspace.folder(step, None)
    page = Path(os.pardir) / os.pardir / NAME
    decision = decide(workspace.manifest(folder), request, folder, force=force)
    target = workspace.out / NAME
    if not decision.run:
        return target, TaskRecord(step.id, None, "up to date", decision.reason, request.fingerprint)
    artifacts: dict[str, Any] = {}
    for slot, producer in step.inputs.items():
        if producer is None:
            artifacts[slot] = None
            continue
        where, manifest = workspace.produced(producer, None)
        output = manifest.outputs.get(slot) if manifest else None
        artifacts[slot] = load_artifact(output.kind, slot, where, list(output.files)) if output else None
    from ssmpipe.report.build import build_report

    html = build_report(record=shown, **artifacts)
    write_atomically(target, html)
    with disk_errors():
        folder.mkdir(parents=True, exist_ok=True)
        outputs = {"report": Output("html", {page.as_posix(): file_digest(target)})}
        manifest = Manifest(step.id, request, outputs, decision.reason, {}, (), versions(), {})
        aside = folder / f".{FILE}"
        manifest.write(aside)
        os.replace(aside, folder / FILE)
    workspace.forget()
    return target, TaskRecord(
        step.id, None, "done", decision.reason, request.fingerprint, seconds=time.perf_counter() - clock
    )
