"""Description length and constraint over the iterations."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ssmpipe.report.figures import AFTER, MUTED, WARN, figure, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section, to_float
from ssmpipe.report.wording import change


def _column(data: ReportData, name: str) -> np.ndarray:
    return np.array([to_float(x) for x in data.history.columns.get(name, ())])


def render(data: ReportData) -> Section | None:
    """Return the two curves of the optimizer, or nothing when it left no history."""
    length = _column(data, "description_length")
    if not np.isfinite(length).any():
        return None
    before, after = (float(x) for x in data.correspondence.description_length)
    smallest = _column(data, "min_jacobian")
    html = fill(
        "history.html.j2",
        plot=svg_uri(_plot(data)),
        n=len(length),
        before=before,
        after=after,
        change=change(before, after),
        normals=data.correspondence.normals is not None,
        lambda_cut=f"{float(data.correspondence.lambda_cut):.3g}",
        smallest=float(np.nanmin(smallest)) if np.isfinite(smallest).any() else None,
    )
    return Section("history", "How the optimization went", html)


def _plot(data: ReportData) -> Figure:
    length, smallest, constraint = (
        _column(data, name) for name in ("description_length", "min_jacobian", "max_constraint")
    )
    step = np.arange(len(length))
    with style():
        made = figure(9.6, 2.8)
        made.subplots_adjust(left=0.05, right=0.995, bottom=0.29, top=0.88, wspace=0.13)
        left, right = made.subplots(1, 2)
        left.plot(step, length, color=AFTER)
        left.set_title("Description length")
        left.set(xlabel="iteration")
        right.axhline(0, color=WARN, linewidth=1)
        if np.isfinite(smallest).any():
            right.plot(step, smallest, color=AFTER, label="smallest local area factor (must stay above 0)")
        if np.isfinite(constraint).any():
            right.plot(
                step,
                constraint,
                color=MUTED,
                linestyle="--",
                linewidth=1.3,
                label="largest constraint (must stay below 0)",
            )
        right.set_title("Constraint")
        right.set(xlabel="iteration")
        if right.get_legend_handles_labels()[0]:
            made.legend(*right.get_legend_handles_labels(), loc="lower right", ncols=2, fontsize=8)
        for axes in (left, right):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        return made
