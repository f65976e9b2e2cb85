"""Landmarks that geometry proposes: where they lie on every scan, for somebody to look at."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section

METRIC = "landmark_candidates"


def candidates_of(shape: Mapping[str, Any]) -> dict[str, str]:
    """Return the places "x y z" in scan coordinates that the stages of one shape proposed, by name; later stages correct earlier ones.

    Examples
    --------
    >>> candidates_of({"stages": [{"metrics": {"landmark_candidates": {"fovea": "1.00 2.00 3.00"}}}, {"metrics": None}]})
    {'fovea': '1.00 2.00 3.00'}
    """
    found: dict[str, str] = {}
    for stage in shape.get("stages") or ():
        found |= (stage.get("metrics") or {}).get(METRIC) or {}
    return found


def render(data: ReportData) -> Section | None:
    """Return a table of shapes and proposed landmarks; nothing when no stage proposes any."""
    shapes = {i: candidates_of(shape or {}) for i, shape in (data.record.get("shapes") or {}).items()}
    names = list(dict.fromkeys(name for found in shapes.values() for name in found))
    if not names:
        return None
    rows = [(i, [found.get(name) for name in names]) for i, found in shapes.items() if found]
    html = fill("candidates.html.j2", names=names, rows=rows)
    return Section("candidates", "Landmarks that geometry proposes", html)
