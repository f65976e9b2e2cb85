"""What a run would do, the report included; nothing is touched."""

from __future__ import annotations

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.machine import machine
from ssmpipe.runner.project import Project
from ssmpipe.runner.record import read_failures, run_record
from ssmpipe.runner.registry import REPORT
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.selection import make_selection
from ssmpipe.runner.workspace import Forecast, Workspace, forecast, make_workspace


def dry_run(project: Project, options: RunOptions) -> list[Forecast]:
    """Return what a run would do, without touching the output folder."""
    chosen = make_selection(project, options)
    workspace = make_workspace(project)
    ready = {s.id for s in chosen.steps if s.prepares and chosen.partial and workspace.prepared_is_usable(s)}
    found = forecast(workspace, chosen.steps, chosen.shapes, chosen.forced, ready)
    return with_report(project, workspace, found, force=REPORT in {project.plan.step(i).stage for i in chosen.forced})


def with_report(
    project: Project, workspace: Workspace, found: list[Forecast], *, force: bool = False
) -> list[Forecast]:
    """Return a forecast with what becomes of the report, when nothing before it would run."""
    named = {item.step for item in found}
    report = next((step for step in project.plan.steps if step.stage == REPORT and step.id in named), None)
    if report is None or any(item.run for item in found if item.step != report.id):
        return found
    from ssmpipe.runner.reporting import report_decision

    # what the report shows besides its inputs is known only here
    record = run_record(project, workspace, read_failures(project.out), {}, {}, machine())
    try:
        decision = report_decision(workspace, report, record, force=force)
    except SsmpipeError:  # a result is missing and not selected: the forecast says so
        return found
    return [Forecast(i.step, i.shape, decision.run, decision.reason) if i.step == report.id else i for i in found]
