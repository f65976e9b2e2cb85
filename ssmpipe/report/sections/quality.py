"""Patient by patient: what the model of all others makes of each, both ways, worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ssmpipe.contract import Table
from ssmpipe.report.figures import AFTER, INK, MUTED, figure, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section, to_float
from ssmpipe.report.units import FILE_UNITS, without_mm

BLOCKS = (
    ("", "Reconstruction to scan"),
    ("back_", "Scan to reconstruction"),
    ("fit_", "Spline to scan"),
    ("fit_back_", "Scan to spline"),
)
WORDS = ("mean", "median", "p99", "max")
SHOWN = 60


@dataclass(frozen=True)
class Row:
    """One shape of the table: place (1 is worst), figures by block and word, p99 of the worse direction over the size."""

    id: str
    place: int
    reference: bool
    size: float
    figures: Mapping[str, Mapping[str, float]]
    relative: float

    @property
    def worse(self) -> float:
        """The larger p99 of the two directions."""
        return max(self.figures["back_"]["p99"], self.figures[""]["p99"])


def quality_rows(table: Table | None) -> list[Row]:
    """Return the rows of ``quality.csv``, worst first; empty when there is no such table."""
    if table is None or not len(table.columns.get("id", ())):
        return []
    columns: Mapping[str, Sequence[Any]] = table.columns
    rows = []
    for i, name in enumerate(columns["id"]):
        figures = {
            block: {word: to_float(columns[f"{block}{word}_dist"][i]) for word in WORDS}
            for block, _ in BLOCKS
            if f"{block}mean_dist" in columns
        }
        size = to_float(columns["bbox_diag"][i])
        relative = max(to_float(columns["norm_p99"][i]), to_float(columns["back_norm_p99"][i]))
        rows.append(Row(str(name), i + 1, bool(int(columns["is_reference"][i])), size, figures, relative))
    return rows


def render(data: ReportData) -> Section | None:
    """Return plot and table, or nothing when the run measured none."""
    rows = quality_rows(data.quality)
    if not rows or data.quality is None:
        return None
    comment = data.quality.comment
    html = fill(
        "quality.html.j2",
        rows=rows,
        blocks=[(key, title) for key, title in BLOCKS if key in rows[0].figures],
        words=WORDS,
        n_modes=int(data.quality.columns["n_modes"][0]),
        plot=svg_uri(_plot(rows[:SHOWN], data.unit)),
        n_plotted=min(len(rows), SHOWN),
        unit=data.unit,
        pages=data.pages,
        comment=without_mm(comment) if data.unit == FILE_UNITS else comment,
    )
    return Section("quality", "Patient by patient", html)


def _plot(rows: Sequence[Row], unit: str) -> Figure:
    height = 0.85 + 0.19 * len(rows)
    with style():
        made = figure(9.6, height)
        made.subplots_adjust(left=0.2, right=0.985, bottom=0.5 / height, top=1 - 0.3 / height)
        axes = made.subplots()
        y = np.arange(len(rows))
        for offset, block, colour, mark, name in (
            (-0.14, "", AFTER, "o", "reconstruction to scan"),
            (0.14, "back_", "#c8641f", "s", "scan to reconstruction"),
        ):
            mean, p99, largest = (np.array([row.figures[block][w] for row in rows]) for w in ("mean", "p99", "max"))
            axes.hlines(y + offset, mean, largest, color=colour, linewidth=0.8, alpha=0.55)
            axes.plot(mean, y + offset, mark, color=colour, markersize=3.2, label=f"{name}: mean, p99, max")
            axes.plot(p99, y + offset, mark, markerfacecolor="white", color=colour, markersize=4.6)
            axes.plot(largest, y + offset, "|", color=colour, markersize=6)
        axes.set_yticks(y, [_short(row.id) for row in rows], fontsize=7.5, color=INK)
        axes.set(ylim=(len(rows) - 0.4, -0.6), xlim=(0, None))
        axes.grid(axis="y", visible=False)
        axes.set_xlabel(f"distance [{unit}]", color=MUTED)
        made.legend(loc="upper right", ncols=2, fontsize=8)
        return made


def _short(name: str) -> str:
    # "$" would start mathematics
    return (name if len(name) <= 26 else name[:25] + "…").replace("$", r"\$")
