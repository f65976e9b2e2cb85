"""What is done, stale and failed, and why; what a run would do; the report written again. Nothing here runs a stage."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.dry_run import with_report
from ssmpipe.runner.lock import locked
from ssmpipe.runner.machine import machine
from ssmpipe.runner.pages import for_report
from ssmpipe.runner.project import Project
from ssmpipe.runner.record import read_failures, run_record
from ssmpipe.runner.registry import REPORT
from ssmpipe.runner.shortage import shortage
from ssmpipe.runner.suggest import count
from ssmpipe.runner.workspace import Forecast, forecast, make_workspace

if TYPE_CHECKING:
    from ssmpipe.runner.console import Console


@dataclass(frozen=True)
class TaskStatus:
    """State of a task: ``done``, ``stale``, ``failed`` or ``to do``; ``shape`` is "" for group tasks, "*" for preparations.

    Not ``certain``: it is stale only when a task before it gives something else than the last time.
    """

    step: str
    shape: str
    state: str
    reason: str
    certain: bool = True


def status_of(project: Project) -> list[TaskStatus]:
    """Compare the output folder with the config, without running or locking anything."""
    workspace = make_workspace(project)
    failures = read_failures(project.out)
    everyone = sorted(project.sources)
    number = {step.id: step.number for step in project.plan.steps}
    stops = {i: number.get(failures[i].get("stage", ""), 0) for i in everyone if i in failures}
    items = with_report(project, workspace, forecast(workspace, project.plan.steps, everyone, stops=stops))
    short = shortage(project.config, len(everyone) - len(stops), len(everyone)) if stops else ""
    found = []
    for item in items:
        step = project.plan.step(item.step)
        shape = None if item.shape in ("", "*") else item.shape
        folder = workspace.prepared_folder(step) if item.shape == "*" else workspace.folder(step, shape)
        exists = workspace.manifest(folder) is not None
        state = "done" if not item.run else "stale" if exists else "to do"
        blocked = short and step.scope == "cohort" and state != "done"
        reason = f"blocked: {short}" if blocked else item.reason
        found.append(TaskStatus(item.step, item.shape, state, reason, item.certain))
    for shape, failure in failures.items():
        if shape in project.sources or shape.startswith("("):
            key = shape if shape in project.sources else ""
            text = failure.get("error", "") + (f"; try: {failure['remedy']}" if failure.get("remedy") else "")
            found = [t for t in found if (t.step, t.shape) != (failure.get("stage"), key)]
            found.append(TaskStatus(failure.get("stage", ""), key, "failed", text))
    for shape, stop in stops.items():
        behind = [step for step in project.plan.steps if step.scope == "shape" and step.number > stop]
        found += [
            TaskStatus(s.id, shape, "to do", f"behind the failure in {failures[shape].get('stage')}") for s in behind
        ]
    return sorted(found, key=lambda t: (number.get(t.step, 0), t.shape != "*", t.shape))


def print_status(tasks: Sequence[TaskStatus], project: Project, console: Console, *, as_json: bool = False) -> None:
    """Print a table with a row per stage, or JSON with a row per task."""
    if as_json:
        rows = [{"step": t.step, "shape": t.shape, "state": t.state, "reason": t.reason} for t in tasks]
        print(json.dumps({"output": str(project.out), "tasks": rows}, indent=1, ensure_ascii=False), flush=True)
        return
    from rich.table import Table as RichTable

    table = RichTable(title=f"{project.config.name}: {project.out}", title_justify="left")
    for name in ("stage", "done", "stale", "maybe", "to do", "failed", "why"):
        table.add_column(name, justify="left" if name in ("stage", "why") else "right")
    for step in project.plan.steps:
        mine = [t for t in tasks if t.step == step.id]
        if not mine:
            continue
        states = Counter(t.state if t.certain else "maybe" for t in mine if t.shape != "*")
        reasons = Counter(t.reason for t in mine if t.state in ("stale", "to do"))
        why = "; ".join(f"{reason} ({n})" if n > 1 else reason for reason, n in reasons.most_common(3))
        table.add_row(step.id, *(str(states[s] or "-") for s in ("done", "stale", "maybe", "to do", "failed")), why)
    console.table(table)
    if any(not task.certain for task in tasks):
        console.say("maybe: runs only when a stage before it gives something else than the last time")
    for task in tasks:
        if task.state == "failed":
            file = f", {project.sources[task.shape].path.name}" if task.shape in project.sources else ""
            console.say(f"failed: {task.shape or 'cohort'}, {task.step}{file}: {task.reason}")
    page = project.out / "report.html"
    if page.is_file():
        console.say(f"report: {page}")


def print_forecast(items: Sequence[Forecast], project: Project, console: Console) -> None:
    """Print what a run would do: a line per stage and reason."""
    for step in project.plan.steps:
        groups: dict[tuple[bool, str, bool], list[str]] = {}
        for item in items:
            if item.step == step.id:
                groups.setdefault((item.run, item.reason, item.shape == "*"), []).append(item.shape)
        for (run, reason, prepare), shapes in groups.items():
            name = f"{step.id} (prepare)" if prepare else step.id
            named = [s for s in shapes if s not in ("", "*")]
            who = f" {', '.join(named[:4])}{', ...' if len(named) > 4 else ''}" if named else ""
            size = f" [{len(named)} shapes]" if len(named) > 1 else ""
            console.say(f"{'run ' if run else 'skip'} {name}{size}:{who}{' -' if named else ''} {reason}")
    tasks = [item for item in items if item.shape != "*"]
    n_run, n_maybe = (sum(item.run for item in tasks if item.certain is sure) for sure in (True, False))
    maybe = f", {n_maybe} more if their input changes" if n_maybe else ""
    current = len(tasks) - n_run - n_maybe
    console.say(f"{count(n_run, 'task')} would run{maybe}, {current} up to date; nothing was touched")


def rewrite_report(project: Project, jobs: int | None = None, console: Console | None = None) -> Path:
    """Write the report again from what is in the output folder; pages of shapes in ``jobs`` children.

    Raises
    ------
    ConfigError
        If the chain has no report stage.
    SsmpipeError
        If the group stages have not been run.
    """
    from ssmpipe.runner.console import Console
    from ssmpipe.runner.reporting import write_report

    step = next((s for s in project.plan.steps if s.stage == REPORT), None)
    if step is None:
        raise ConfigError("this chain has no stage 'report'", "add '- report' to stages")
    console = console or Console()
    with locked(project.out), for_report(project, jobs, console) as (workspace, batch):
        record = run_record(project, workspace, read_failures(project.out), {}, {}, machine())
        path, _ = write_report(workspace, step, record, batch, console.warn, force=True)
    return path
