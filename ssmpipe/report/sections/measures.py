"""Compactness, generalization and specificity, before and after."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssmpipe.report.figures import SERIES, figure, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.section import Group, ReportData, Section, by_correspondence
from ssmpipe.report.wording import CORRESPONDENCE_TITLES

PANELS = (
    ("compactness", "compactness_error", "Compactness", "share of variance", "higher is better"),
    ("generalization", "generalization_se", "Generalization", "error [{unit}]", "lower is better"),
    ("specificity", "specificity_se", "Specificity", "distance [{unit}]", "lower is better"),
)


def render(data: ReportData) -> Section | None:
    """Return the three measures as curves and as a table, or nothing when the table is empty."""
    groups = by_correspondence(data.measures)
    if not groups:
        return None
    panels = [panel for panel in PANELS if any(panel[0] in group.columns for group in groups)]
    numbers = sorted({n for group in groups for n in group.columns.get("n_modes", ())})
    rows = []
    for n in numbers:
        row = []
        for name, error, *_ in panels:
            for group in groups:
                at = [i for i, m in enumerate(group.columns["n_modes"]) if m == n]
                value, spread = (
                    group.columns[key][at[0]] if at and key in group.columns else float("nan") for key in (name, error)
                )
                row.append((value, spread))
        rows.append((int(n), row))
    html = fill(
        "measures.html.j2",
        plot=svg_uri(_plot(groups, panels, data.unit)),
        panels=panels,
        groups=[CORRESPONDENCE_TITLES.get(group.name, group.name) for group in groups],
        rows=rows,
        unit=data.unit,
        alone=data.landmark_transfer is None,
    )
    return Section("measures", "Quality of the model", html)


def _plot(groups: list[Group], panels: list[tuple[str, str, str, str, str]], unit: str) -> Figure:
    with style():
        made = figure(9.6, 2.9)
        made.subplots_adjust(left=0.055, right=0.995, bottom=0.29, top=0.88, wspace=0.24)
        for axes, (name, error, title, axis, better) in zip(
            made.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            for shift, group in enumerate(groups):
                if name not in group.columns:
                    continue
                n = np.array(group.columns["n_modes"]) + 0.08 * (shift - (len(groups) - 1) / 2)
                y = np.array(group.columns[name])
                spread = np.array(group.columns.get(error, np.zeros_like(y)))
                axes.errorbar(
                    n,
                    y,
                    yerr=np.where(np.isfinite(spread), spread, 0.0),
                    color=SERIES.get(group.name, "#7a5c99"),
                    marker="o",
                    markersize=3.5,
                    capsize=2,
                    elinewidth=0.9,
                    label=CORRESPONDENCE_TITLES.get(group.name, group.name),
                )
            axes.set_title(title)
            axes.set_title(better, loc="right", fontsize=8, fontweight="normal", color="#66727f")
            axes.set(xlabel="number of modes", ylabel=axis.format(unit=unit))
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_ylim(0, 1.05 if name == "compactness" else None)
        handles, names = made.axes[0].get_legend_handles_labels()
        made.legend(handles, names, loc="lower center", ncols=len(names))
        return made
