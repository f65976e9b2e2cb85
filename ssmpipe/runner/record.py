"""The record of a run: run.json, failures.json, and what the report is told."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from ssmpipe.contract import Stage
from ssmpipe.runner.disk import disk_errors, write_atomically
from ssmpipe.runner.execute import TIMING, TaskRecord, versions
from ssmpipe.runner.fingerprint import VOLATILE
from ssmpipe.runner.plan import PlannedStep
from ssmpipe.runner.project import Project
from ssmpipe.runner.workspace import Workspace

FAILURES = "failures.json"


def read_failures(out: Path) -> dict[str, dict[str, str]]:
    """Return what failures.json says: {id: {stage, file, error, remedy}}; empty when there is none."""
    try:
        data = json.loads((out / FAILURES).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def write_failures(out: Path, failures: Mapping[str, Mapping[str, str]], *, parts: bool = False) -> None:
    """Write failures.json, or remove it when nothing failed; with ``parts``, entries of other parts are kept."""
    path = out / FAILURES
    with disk_errors(), FileLock(out / ".failures.lock", timeout=30):
        entries = {**(read_failures(out) if parts else {}), **failures}
        if entries:
            text = json.dumps(dict(sorted(entries.items())), indent=1, ensure_ascii=False)
            write_atomically(path, text + "\n")
        else:
            path.unlink(missing_ok=True)


def methods_sentence(stage: Stage, options: Mapping[str, Any]) -> str:
    """Return the stage's sentence for the methods paragraph, its options filled in."""
    if not isinstance(stage.methods, str):
        return stage.methods(options)

    def text(value: Any) -> str:
        if isinstance(value, list):
            return " x ".join(text(v) for v in value)
        if isinstance(value, str) and value.startswith("file:"):
            return "a given file"
        if value is None:
            return "none"
        return f"{value:g}" if isinstance(value, float) else str(value)

    class Values(dict):
        def __missing__(self, key: str) -> str:
            return "{" + key + "}"

    return stage.methods.format_map(Values({key: text(value) for key, value in options.items()}))


def methods_of(project: Project) -> list[dict[str, Any]]:
    """Return sentence and citations of every stage in the order of the chain."""
    return [
        {"stage": s.stage.name, "sentence": methods_sentence(s.stage, s.options), "cites": list(s.stage.cites)}
        for s in project.steps
        if s.stage.methods
    ]


def task_entry(
    workspace: Workspace,
    step: PlannedStep,
    shape: str | None,
    record: TaskRecord | None,
    failure: Mapping[str, str] | None,
) -> dict[str, Any]:
    """Return what is known of one task: of this run, else of the manifest on disk."""
    folder = workspace.folder(step, shape)
    manifest = workspace.manifest(folder)
    entry: dict[str, Any] = {"stage": step.stage, "step": step.id, "folder": folder.name}
    if failure is not None and failure.get("stage") == step.id:
        return {**entry, "status": "failed", "reason": failure.get("error", "")}
    if manifest is None:
        return {**entry, "status": "not run", "reason": "failed before" if failure else ""}
    entry |= {
        "status": record.status if record else "not checked",
        "reason": manifest.reason if record and record.status == "done" else (record.reason if record else ""),
        "fingerprint": manifest.request.fingerprint,
        "metrics": dict(manifest.metrics),
        "warnings": list(manifest.warnings),
    }
    with contextlib.suppress(OSError, ValueError):
        entry["timing"] = json.loads((folder / TIMING).read_text(encoding="utf-8"))
    return entry


def run_record(
    project: Project,
    workspace: Workspace,
    failures: Mapping[str, Mapping[str, str]],
    records: Mapping[tuple[str, str | None], TaskRecord],
    totals: Mapping[str, Any],
    machine: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of run.json."""
    workspace.forget()
    shapes: dict[str, Any] = {}
    for shape, source in sorted(project.sources.items()):
        tasks = [
            task_entry(workspace, step, shape, records.get((step.id, shape)), failures.get(shape))
            for step in project.plan.steps
            if step.scope == "shape"
        ]
        shapes[shape] = {
            "file": source.path.name,
            "info": {"side": source.side, **dict(source.columns)},
            "stages": tasks,
        }
    cohort = [
        task_entry(workspace, step, None, records.get((step.id, None)), failures.get("(cohort)"))
        for step in project.plan.steps
        if step.scope == "cohort"
    ]
    return {
        "name": project.config.name,
        "ssmpipe_version": versions()["ssmpipe"],
        "versions": {k: v for k, v in versions().items() if k != "ssmpipe"},
        "seed": project.config.seed,
        "config_file": str(project.path),
        "config": resolved_config(project),
        "shapes": shapes,
        "cohort_stages": cohort,
        "failures": dict(failures),
        "methods": methods_of(project),
        "machine": dict(machine),
        "timings": dict(totals),
        "volatile": volatile_files(workspace),
    }


def resolved_config(project: Project) -> dict[str, Any]:
    """Return the config with every default and option filled in."""
    config = project.config.model_dump(mode="json")
    config["stages"] = [
        {s.stage.name: {**({"id": s.id} if s.id != s.stage.name else {}), **dict(s.options)}} for s in project.steps
    ]
    return config


def volatile_files(workspace: Workspace) -> list[str]:
    """Return patterns, relative to the output folder, of the files that hold clock readings or machine facts."""
    found = [
        "run.json",
        "run.part-*.json",
        ".lock*",
        ".work/**",
        ".checkpoints/**",
        "shapes/*/*/timing.json",
        "cohort/*/timing.json",
    ]
    for step in workspace.plan.steps:
        base = "cohort/" + step.id if step.scope == "cohort" else f"shapes/*/{step.folder}"
        slots = [port.slot for port in step.outputs if port.volatile]
        if not slots:
            continue
        folders = [workspace.out / base] if step.scope == "cohort" else sorted(workspace.out.glob(base))
        for folder in folders:
            manifest = workspace.manifest(folder)
            names = {
                n
                for slot in slots
                if manifest and slot in manifest.outputs
                for n, sha in manifest.outputs[slot].files.items()
                if sha == VOLATILE
            }
            found += [f"{base}/{name}" for name in sorted(names)]
    return list(dict.fromkeys(found))


def report_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a run's record that the report shows: the same results give the same report, whenever it is made."""

    def plain(tasks: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [
            {**{k: t[k] for k in ("stage", "step", "folder")}, "metrics": t.get("metrics", {}),
             "warnings": t.get("warnings", []), "status": "done" if t.get("fingerprint") else t["status"]}
            for t in tasks
            if t["stage"] != "report"
        ]  # fmt: skip

    keep = ("name", "ssmpipe_version", "versions", "seed", "failures", "methods")
    # where the work was done does not show in the results, and so not here
    config = {key: value for key, value in record["config"].items() if key not in ("executor", "scheduler", "tls")}
    config["limits"] = {key: value for key, value in config["limits"].items() if key != "checkpoint_every"}
    return {
        **{key: record[key] for key in keep},
        "config": config,
        "shapes": {i: {**shape, "stages": plain(shape["stages"])} for i, shape in record["shapes"].items()},
        "cohort_stages": plain(record["cohort_stages"]),
    }
