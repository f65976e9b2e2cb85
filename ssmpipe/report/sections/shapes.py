"""Every shape through the stages: sizes, quality of fit, certificate, warnings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section, to_float
from ssmpipe.report.sections.candidates import METRIC


def stage_key(stage: Mapping[str, Any]) -> str:
    """Return what tells a stage from its repeats: the folder, or the name."""
    return str(stage.get("folder") or stage.get("stage") or "?")


def _metric(stage: Mapping[str, Any], *names: str) -> Any:
    metrics = stage.get("metrics") or {}
    return next((metrics[name] for name in names if name in metrics), None)


def render(data: ReportData) -> Section | None:
    """Return the table of shapes, the warnings and, folded away, every number that a stage recorded."""
    if not data.shapes:
        return None
    keys = _stage_order(data)
    sizes = _size_columns(data, keys)
    certificates = data.certificate.get("shapes") or {}
    rows = []
    for key, shape in sorted(data.shapes.items(), key=lambda item: (item[0] not in data.failures, item[0])):
        by_key = {stage_key(stage): stage for stage in shape.get("stages") or ()}
        fit: Mapping[str, Any] = next((stage for stage in by_key.values() if stage.get("stage") == "fit"), {})
        rows.append(
            {
                "id": key,
                "side": (shape.get("info") or {}).get("side"),
                "sizes": [sizes[column].get(key) for column in sizes],
                "rms": _largest(fit, "rms"),
                "max": _largest(fit, "max"),
                "certificate": certificates.get(key) or {},
                "failed": data.failures.get(key),
                "n_warnings": sum(len(stage.get("warnings") or ()) for stage in by_key.values()),
                "warnings": [
                    (stage.get("stage", "?"), text) for stage in by_key.values() for text in stage.get("warnings") or ()
                ],
            }
        )
    html = fill(
        "shapes.html.j2",
        columns=list(sizes),
        rows=rows,
        details=[_detail(data, key) for key in keys],
        cohort_stages=data.record.get("cohort_stages") or [],
        has_fit=any(row["rms"] is not None for row in rows),
        unit=data.unit,
        pages=data.pages,
    )
    return Section("shapes", "Shapes through the stages", html)


def _stage_order(data: ReportData) -> list[str]:
    found = {stage_key(stage) for shape in data.shapes.values() for stage in shape.get("stages") or ()}
    if all(key[:2].isdigit() for key in found):
        return sorted(found)
    longest = max((shape.get("stages") or () for shape in data.shapes.values()), key=len, default=())
    first = [stage_key(stage) for stage in longest]
    return first + sorted(found - set(first))


def _title(key: str) -> str:
    head, _, tail = key.partition("-")
    return tail if head.isdigit() and tail else key


def _size_columns(data: ReportData, keys: list[str]) -> dict[str, dict[str, tuple[Any, Any]]]:
    """Vertices and faces by stage and shape; a stage that changes neither is left out."""
    columns: dict[str, dict[str, tuple[Any, Any]]] = {}
    before: dict[str, tuple[Any, Any]] = {}
    for key in keys:
        raw: dict[str, tuple[Any, Any]] = {}
        after: dict[str, tuple[Any, Any]] = {}
        for name, shape in data.shapes.items():
            for stage in shape.get("stages") or ():
                if stage_key(stage) != key:
                    continue
                given = (
                    _metric(stage, "n_vertices_in", "n_vertices_before"),
                    _metric(stage, "n_faces_in", "n_faces_before"),
                )
                size = (
                    _metric(stage, "n_vertices", "n_vertices_out", "n_vertices_after"),
                    _metric(stage, "n_faces", "n_faces_out", "n_faces_after"),
                )
                if given != (None, None):
                    raw[name] = given
                if size != (None, None):
                    after[name] = size
        if raw and not columns:
            columns["scan"] = raw
            before = raw
        if after and any(before.get(name) != size for name, size in after.items()):
            columns[_title(key)] = after
            before = {**before, **after}
    return columns


def _largest(stage: Mapping[str, Any], word: str) -> Any:
    metrics = stage.get("metrics") or {}
    values = [to_float(metrics[name]) for name in metrics if word in name.split("_")]
    return max(values) if values else None


def _detail(data: ReportData, key: str) -> dict[str, Any]:
    rows = []
    names: dict[str, None] = {}
    for shape_id, shape in data.shapes.items():
        for stage in shape.get("stages") or ():
            if stage_key(stage) == key:
                metrics = stage.get("metrics") or {}
                names |= dict.fromkeys(name for name in metrics if name != METRIC)
                rows.append((shape_id, stage.get("status", ""), metrics))
    table = [(shape_id, status, [_short(metrics.get(name)) for name in names]) for shape_id, status, metrics in rows]
    return {"title": _title(key), "names": list(names), "rows": table}


def _short(value: Any) -> Any:
    if isinstance(value, (list, tuple)) and len(value) > 4:
        return f"{len(value)} values"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {item}" for key, item in value.items())[:80]
    return value
