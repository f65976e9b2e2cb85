"""The leading modes as still pictures at -3, 0 and +3 standard deviations."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize

from ssmpipe.core.arrays import Floats
from ssmpipe.report.figures import AFTER, BEFORE, SIGNED, figure, png_uri, ramp_uri, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.payload import in_space
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.solid import good_view, picture, vertex_normals, view_axes
from ssmpipe.report.wording import number, percent

SIGMAS = (-3.0, 0.0, 3.0)
SHOWN = 5


def nice_ceiling(x: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is at least ``x``.

    Examples
    --------
    >>> nice_ceiling(3.2), nice_ceiling(0.11)
    (5.0, 0.2)
    """
    if not x > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(x))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power >= x * 0.999))


def render(data: ReportData) -> Section | None:
    """Return one row of pictures per mode, coloured by signed distance from the mean."""
    model = data.model
    n_modes = min(SHOWN, len(model.modes))
    if n_modes == 0:
        return None
    shares = model.variances / (model.variances.sum() or 1.0)
    walks = [[in_space(model.instance(sigma * np.eye(n_modes)[k])) for sigma in SIGMAS] for k in range(n_modes)]
    draw = _surfaces if len(model.faces) else _curves
    rows = []
    for k, instances in enumerate(walks):
        pictures, limit = draw(data, instances, np.concatenate([points for walk in walks for points in walk]))
        rows.append(
            {
                "number": k + 1,
                "share": percent(float(shares[k]), 1),
                "sd": number(float(np.sqrt(model.variances[k] / len(model.mean)))),
                "limit": f"{limit:g}",
                "largest": number(float(np.linalg.norm(instances[2] - instances[1], axis=1).max())),
                "pictures": list(zip(("−3 σ", "mean", "+3 σ"), pictures, strict=True)),
            }
        )
    return Section(
        "modes",
        "Modes of variation",
        fill("modes.html.j2", rows=rows, unit=data.unit, ramp=ramp_uri(), flat=not len(model.faces)),
    )


def _surfaces(data: ReportData, instances: list[Floats], everything: Floats) -> tuple[list[str], float]:
    faces, mean = data.model.faces, in_space(data.model.mean)
    view = good_view(mean, faces)
    normals = vertex_normals(mean, faces)
    right_up = everything @ view_axes(*view)[:2].T
    low, high = right_up.min(axis=0), right_up.max(axis=0)
    centre = (low + high) / 2 @ view_axes(*view)[:2]
    radius = 0.52 * float((high - low).max())
    distances = [((points - mean) * normals).sum(axis=1) for points in instances]
    limit = nice_ceiling(float(np.quantile(np.abs(np.concatenate(distances)), 0.98)))
    uris = []
    for points, distance in zip(instances, distances, strict=True):
        colours = None if not np.any(distance) else SIGNED(Normalize(-limit, limit)(distance))[:, :3]
        uris.append(png_uri(picture(points, faces, view=view, centre=centre, radius=radius, colours=colours)))
    return uris, limit


def _curves(data: ReportData, instances: list[Floats], everything: Floats) -> tuple[list[str], float]:
    closed = data.model.topology == "curve-closed"
    mean = in_space(data.model.mean)
    uris = []
    for points in instances:
        with style():
            made = figure(2.2, 2.2)
            panel = made.add_axes((0.04, 0.04, 0.92, 0.92))
            for curve, colour in ((mean, BEFORE), (points, AFTER)):
                line = np.concatenate([curve, curve[:1]]) if closed else curve
                panel.plot(line[:, 0], line[:, 1], color=colour)
            panel.set_axis_off()
            panel.set_aspect("equal")
            panel.set(
                xlim=(everything[:, 0].min(), everything[:, 0].max()),
                ylim=(everything[:, 1].min(), everything[:, 1].max()),
            )
            uris.append(svg_uri(made))
    return uris, 0.0
