"""Where the optimizer moved the points: the deformed parameter grid of every shape."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize

from ssmpipe.core.arrays import Floats
from ssmpipe.report.figures import AFTER, BEFORE, SIGNED, figure, pixels, png_uri, ramp_uri, style, svg_uri
from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.wording import number

PERIODIC = ("tube", "cone", "closed")


def grid_nodes(parameters: Floats, grid: tuple[int, ...], topology: str) -> Floats:
    """Return (n_1, n_2, 2) grid nodes in the domain; a periodic grid gets its first row again at the end, one period on.

    Examples
    --------
    >>> u = np.array([[0.6, 0], [0.6, 1], [0.9, 0], [0.9, 1], [0.2, 0], [0.2, 1]])
    >>> grid_nodes(u, (3, 2), "tube")[:, 0, 0]
    array([0.6, 0.9, 1.2, 1.6])
    """
    nodes = np.array(parameters, dtype=np.float64).reshape(*grid, 2)
    if topology in PERIODIC:
        nodes[..., 0] = np.unwrap(nodes[..., 0], axis=0, period=1.0)
        again = nodes[:1].copy()
        again[..., 0] += 1.0
        nodes = np.concatenate([nodes, again])
    return nodes


def area_factors(nodes: Floats) -> Floats:
    """Return the area of every grid cell relative to the undeformed one, negative where the cell is turned over.

    Examples
    --------
    >>> u = np.stack(np.meshgrid([0, 0.5, 1], [0, 0.5, 1], indexing="ij"), axis=-1)
    >>> area_factors(u)
    array([[1., 1.],
           [1., 1.]])
    """
    one = nodes[1:, 1:] - nodes[:-1, :-1]
    two = nodes[:-1, 1:] - nodes[1:, :-1]
    area = 0.5 * (one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    return area * area.size


def render(data: ReportData) -> Section | None:
    """Return one small picture per shape."""
    c = data.correspondence
    if c.parameters.ndim != 3 or len(c.ids) == 0:
        return None
    flat = c.parameters.shape[2] == 1 or len(c.grid) == 1
    items = []
    if flat:
        for key, u in zip(c.ids, c.parameters[..., 0], strict=True):
            items.append(
                {
                    "id": key,
                    "picture": _curve(u),
                    "low": float(np.diff(u).min() * (len(u) - 1)),
                    "high": float(np.diff(u).max() * (len(u) - 1)),
                }
            )
        limit = 1.0
    else:
        nodes = [grid_nodes(p, tuple(c.grid), c.topology) for p in c.parameters]
        factors = [area_factors(n) for n in nodes]
        positive = np.concatenate([f[f > 0] for f in factors])
        limit = (
            float(np.clip(np.ceil(2 * np.quantile(np.abs(np.log2(positive)), 0.99)) / 2, 0.5, 4.0))
            if positive.size
            else 1.0
        )
        for key, n, f in zip(c.ids, nodes, factors, strict=True):
            items.append(
                {"id": key, "picture": grid_picture(n, f, limit), "low": float(f.min()), "high": float(f.max())}
            )
    reference = c.ids[c.reference] if 0 <= c.reference < len(c.ids) else None
    html = fill(
        "grids.html.j2",
        items=items,
        flat=flat,
        reference=reference,
        low=number(2.0**-limit, 2),
        high=number(2.0**limit, 2),
        ramp=ramp_uri(),
    )
    return Section("grids", "Where the points moved", html)


def grid_picture(nodes: Floats, factors: Floats, limit: float) -> str:
    """Return the deformed grid, coloured by the binary logarithm of the area factors up to ``limit``; black where it folds."""
    with style():
        made = figure(1.9, 1.9)
        panel = made.add_axes((0.01, 0.01, 0.98, 0.98))
        panel.set_axis_off()
        u, v = nodes[..., 0], nodes[..., 1]
        signed = np.log2(np.maximum(factors, 2.0**-8))
        panel.pcolormesh(u, v, signed, cmap=SIGNED, norm=Normalize(-limit, limit), antialiased=False)
        if (factors <= 0).any():
            panel.pcolormesh(
                u, v, np.ma.masked_where(factors > 0, factors), cmap="gray", vmin=1, vmax=2, antialiased=False
            )
        for axis in (0, 1):
            n = nodes.shape[axis]
            for i in np.unique(np.linspace(0, n - 1, min(n, 18)).round().astype(int)):
                line = np.take(nodes, i, axis=axis)
                panel.plot(
                    line[:, 0],
                    line[:, 1],
                    color="#1c2733",
                    linewidth=0.9 if i in (0, n - 1) else 0.45,
                    solid_capstyle="butt",
                )
        panel.set(xlim=(u.min() - 0.01, u.max() + 0.01), ylim=(v.min() - 0.01, v.max() + 0.01))
        return png_uri(pixels(made, 160), 96)


def _curve(u: Floats) -> str:
    with style():
        made = figure(1.9, 1.9)
        panel = made.add_axes((0.16, 0.14, 0.8, 0.8))
        straight = np.linspace(0, 1, len(u))
        panel.plot(straight, straight, color=BEFORE, linewidth=1)
        panel.plot(straight, u, color=AFTER)
        panel.set_aspect("equal")
        return svg_uri(made)
