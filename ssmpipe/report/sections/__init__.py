"""The sections of the report in reading order; a new one is a file here and a line below."""

from __future__ import annotations

from collections.abc import Callable

from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.sections import (
    candidates,
    grids,
    history,
    landmarks,
    measures,
    methods,
    modes,
    provenance,
    quality,
    scores,
    shapes,
    summary,
    viewer,
)

SECTIONS: tuple[Callable[[ReportData], Section | None], ...] = (
    summary.render,
    viewer.render,
    modes.render,
    measures.render,
    landmarks.render,
    candidates.render,
    quality.render,
    scores.render,
    shapes.render,
    history.render,
    grids.render,
    methods.render,
    provenance.render,
)
