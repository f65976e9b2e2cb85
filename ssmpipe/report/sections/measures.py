"""Compactness, generalization and specificity, before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssmpipe.report.figures import SERIES, figure, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.section import Group, ReportData, Section, by_correspondence
from ssmpipe.report.wording import CORRESPONDENCE_TITLES


@dataclass(frozen=True)
class Measure:
    """A column of the table of measures: its error column, title, label of the axis, and which way is better."""

    column: str
    error: str
    title: str
    axis: str
    better: str


CURVES = (
    Measure("compactness", "", "Compactness", "share of variance", "higher is better"),
    Measure("generalization", "generalization_se", "Generalization", "error [{unit}]", "lower is better"),
    Measure("specificity", "specificity_se", "Specificity", "distance [{unit}]", "lower is better"),
)
# of the variance itself, hence in squared units: no bar on a share
EXTRA = (Measure("compactness_error", "", "Compactness error", "[{unit}² per point]", "lower is better"),)


def render(data: ReportData) -> Section | None:
    """Return the three measures as curves and as a table, or nothing when the table is empty."""
    groups = by_correspondence(data.measures)
    if not groups:
        return None

    def present(measures: tuple[Measure, ...]) -> list[Measure]:
        return [measure for measure in measures if any(measure.column in group.columns for group in groups)]

    numbers = sorted({n for group in groups for n in group.columns.get("n_modes", ())})
    columns = present(CURVES[:1] + EXTRA + CURVES[1:])
    rows = []
    for n in numbers:
        cells = [(_at(group, n, column.column), _at(group, n, column.error)) for column in columns for group in groups]
        rows.append((int(n), cells))
    html = fill(
        "measures.html.j2",
        plot=svg_uri(_plot(groups, present(CURVES), data.unit)),
        columns=[
            (column.title, column.axis[column.axis.find("[") :].format(unit=data.unit) if "[" in column.axis else "")
            for column in columns
        ],
        groups=[CORRESPONDENCE_TITLES.get(group.name, group.name) for group in groups],
        rows=rows,
        alone=data.landmark_transfer is None,
    )
    return Section("measures", "Quality of the model", html)


def _at(group: Group, n_modes: float, column: str) -> float:
    for m, value in zip(group.columns.get("n_modes", ()), group.columns.get(column, ()), strict=False):
        if m == n_modes:
            return value
    return float("nan")


def _plot(groups: list[Group], measures: list[Measure], unit: str) -> Figure:
    with style():
        made = figure(9.6, 2.9)
        made.subplots_adjust(left=0.055, right=0.995, bottom=0.29, top=0.88, wspace=0.24)
        for axes, measure in zip(made.subplots(1, len(measures), squeeze=False)[0], measures, strict=True):
            for shift, group in enumerate(groups):
                if measure.column not in group.columns:
                    continue
                n = np.array(group.columns["n_modes"]) + 0.08 * (shift - (len(groups) - 1) / 2)
                y = np.array(group.columns[measure.column])
                spread = np.array(group.columns.get(measure.error, np.zeros_like(y)))
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
            axes.set_title(measure.title)
            axes.set_title(measure.better, loc="right", fontsize=8, fontweight="normal", color="#66727f")
            axes.set(xlabel="number of modes", ylabel=measure.axis.format(unit=unit))
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_ylim(0, 1.05 if measure.column == "compactness" else None)
        handles, names = made.axes[0].get_legend_handles_labels()
        made.legend(handles, names, loc="lower center", ncols=len(names))
        return made
