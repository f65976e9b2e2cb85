"""Marked landmarks carried from shape to shape: the check from outside."""

from __future__ import annotations

from ssmpipe.contract import Table
from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.units import FILE_UNITS, without_mm
from ssmpipe.report.wording import CORRESPONDENCE_TITLES

OVERALL = ("all", "overall", "total")


def render(data: ReportData) -> Section | None:
    """Return the transfer table: a row per landmark, columns per correspondence; nothing when there are no landmarks."""
    table = data.landmark_transfer
    if table is None or not table.columns or not len(next(iter(table.columns.values()))):
        return None
    html = fill(
        "landmarks.html.j2",
        pivot=_pivot(table, data.unit),
        columns=dict(table.columns),
        guided=_guided(data),
        comment=without_mm(table.comment) if data.unit == FILE_UNITS else table.comment,
    )
    return Section("landmarks", "Landmark transfer", html)


def _guided(data: ReportData) -> bool:
    """Whether the config names landmarks that guide the optimization."""
    stages = (data.record.get("config") or {}).get("stages") or ()
    return any((stage.get("optimize") or {}).get("guides") for stage in stages)


def _pivot(table: Table, unit: str = "mm") -> dict | None:
    columns = table.columns
    if "landmark" not in columns or "correspondence" not in columns:
        return None
    values = [key for key in columns if key not in {"landmark", "correspondence"}]
    names = list(dict.fromkeys(str(name) for name in columns["correspondence"]))
    names.sort(key=lambda name: {"initial": 0, "optimized": 1}.get(name, 2))
    marks = list(dict.fromkeys(str(name) for name in columns["landmark"]))
    marks.sort(key=lambda name: name.lower() in OVERALL)
    cells = {
        (str(mark), str(name)): i
        for i, (mark, name) in enumerate(zip(columns["landmark"], columns["correspondence"], strict=True))
    }
    # a column that does not depend on the correspondence (a count, the raters' spread) is shown once
    common = [
        key for key in values
        if all(len({str(columns[key][cells[m, n]]) for n in names if (m, n) in cells}) <= 1 for m in marks)
        and (key.startswith("n_") or "rater" in key)
    ]  # fmt: skip
    varying = [key for key in values if key not in common]
    in_mm = bool(varying) and all(key.endswith("_mm") for key in varying)
    rows = []
    for mark in marks:
        first = next(cells[mark, name] for name in names if (mark, name) in cells)
        rows.append(
            {
                "name": mark,
                "overall": mark.lower() in OVERALL,
                "common": [columns[key][first] for key in common],
                "values": [
                    columns[key][cells[mark, name]] if (mark, name) in cells else None
                    for name in names
                    for key in varying
                ],
            }
        )
    return {
        "common": common,
        "varying": [key.removesuffix("_mm") for key in varying] if in_mm else varying,
        "unit": unit if in_mm else "",
        "groups": [CORRESPONDENCE_TITLES.get(name, name.replace("_", " ").replace("-", " ")) for name in names],
        "rows": rows,
    }
