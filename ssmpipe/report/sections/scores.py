"""Where the shapes lie in the space of the modes, by every column of the cohort table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ssmpipe.report.figures import AFTER, CATEGORIES, INK, MARKS, figure, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import MAX_GROUPS, cohort_columns
from ssmpipe.report.section import ReportData, Section, to_float
from ssmpipe.report.wording import percent

MAX_COLUMNS = 12
NAMED = 40  # more shapes than this are not named in the plot


def render(data: ReportData) -> Section | None:
    """Return a plot per column: leading modes against each other; nothing when there is only one shape or no mode."""
    if len(data.model.ids) < 3 or data.model.scores.shape[1] == 0:
        return None
    columns = cohort_columns(data.model.ids, data.shapes)
    plots: list[tuple[str, str, str]] = []
    left_out: list[str] = []
    for name, values in columns.items():
        kind = column_kind(values)
        if not kind:
            left_out.append(name)
        elif len(plots) < MAX_COLUMNS:
            plots.append((name, kind, svg_uri(_plot(data, name, values, kind))))
    if not plots:
        plots = [("", "plain", svg_uri(_plot(data, "", [""] * len(data.model.ids), "plain")))]
    html = fill("scores.html.j2", plots=plots, left_out=left_out, named=len(data.model.ids) <= NAMED)
    return Section("scores", "Where the shapes lie", html)


def column_kind(values: Sequence[str]) -> str:
    """Return "number", "group", or "" for a column that has a text of its own for every shape, or the same for all.

    Examples
    --------
    >>> column_kind(["1.5", "2", "7", "", "3", "9"]), column_kind(["L", "R", "L"]), column_kind(["a", "b", "c"])
    ('number', 'group', '')
    """
    given = [value for value in values if value]
    different = len(set(given))
    if different < 2:
        return ""
    if np.isfinite([to_float(value) for value in given]).all() and different > 4:
        return "number"
    return "group" if different <= MAX_GROUPS and different < len(given) else ""


def _plot(data: ReportData, name: str, values: Sequence[str], kind: str) -> Figure:
    scores = data.model.scores[:, : len(data.model.variances)]
    shares = data.model.variances / (data.model.variances.sum() or 1.0)
    pairs = [(0, 1), (2, 3)] if scores.shape[1] > 3 else [(0, min(1, scores.shape[1] - 1))]
    with style():
        made = figure(9.6, 3.9)
        made.subplots_adjust(left=0.055, right=0.84, bottom=0.13, top=0.96, wspace=0.2)
        for axes, (a, b) in zip(made.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
            x, y = scores[:, a], scores[:, b]
            axes.axhline(0, color="#c3cbd3", linewidth=0.8)
            axes.axvline(0, color="#c3cbd3", linewidth=0.8)
            if kind == "number":
                numbers = np.array([to_float(value) for value in values])
                known = np.isfinite(numbers)
                drawn = axes.scatter(
                    x[known], y[known], c=numbers[known], cmap="viridis", s=34, edgecolors=INK, linewidths=0.4
                )
                axes.scatter(x[~known], y[~known], facecolors="none", edgecolors=INK, s=34, linewidths=0.6)
                if (a, b) == pairs[-1]:
                    bar = made.colorbar(drawn, cax=made.add_axes((0.875, 0.14, 0.016, 0.7)))
                    bar.outline.set_visible(False)
                    made.text(0.865, 0.9, _safe(name), fontsize=9, fontweight="bold")
            else:
                for i, value in enumerate(sorted(set(values), key=lambda v: (v == "", v))):
                    mine = np.array([other == value for other in values])
                    colour, mark = (CATEGORIES[i % 8], MARKS[i % 8]) if value or kind == "plain" else ("#98a3ae", "x")
                    axes.scatter(
                        x[mine],
                        y[mine],
                        color=AFTER if kind == "plain" else colour,
                        marker=mark,
                        s=30,
                        label=_safe(value) or "no value",
                    )
                if (a, b) == pairs[-1] and kind == "group":
                    made.legend(
                        *axes.get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(0.845, 0.97), title=_safe(name),
                        fontsize=8, alignment="left", title_fontproperties={"weight": "bold", "size": 9},
                    )  # fmt: skip
            if len(x) <= NAMED:
                for key, px, py in zip(data.model.ids, x, y, strict=True):
                    axes.annotate(_safe(key), (px, py), (4, 3), textcoords="offset points", fontsize=6, color="#5d6975")
            axes.set(
                xlabel=f"mode {a + 1} [σ], {percent(float(shares[a]))}",
                ylabel=f"mode {b + 1} [σ], {percent(float(shares[b]))}",
            )
        return made


def _safe(text: str) -> str:
    return (text if len(text) <= 18 else text[:17] + "…").replace("$", r"\$")
