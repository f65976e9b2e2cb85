"""Pictures as data URIs: the same figure gives the same bytes."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

INK = "#1c2733"
MUTED = "#66727f"
BEFORE = "#98a3ae"
AFTER = "#17608f"
BONE = "#e4d9c4"
WARN = "#b3541e"
SERIES = {"initial": BEFORE, "optimized": AFTER}

# inward blue, mean white, outward red; dark ends differ in lightness too, so that a grey print still tells the size
SIGNED_STOPS = ("#1f4e8c", "#4f86bd", "#a3c6e0", "#f3f1ec", "#efb79a", "#d0674f", "#8f2330")
SIGNED = LinearSegmentedColormap.from_list("ssmpipe-signed", SIGNED_STOPS, N=256)

CATEGORIES = ("#17608f", "#c8641f", "#2c7a56", "#8a4f9e", "#8d6a2e", "#b23a5b", "#4f5b66", "#1f9aa5")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")  # so that groups differ without colour as well

_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 10,
    "axes.edgecolor": "#9aa4ae",
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e7ebef",
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "svg.hashsalt": "ssmpipe",
    "svg.fonttype": "path",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.unicode_minus": True,
}


@contextmanager
def style() -> Iterator[None]:
    """Use the report's look whatever the user's matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def figure(width: float, height: float) -> Figure:
    """Return an empty figure of ``width`` x ``height`` inches that no window system knows of.

    Margins are the caller's: the automatic layouts differ from run to run in the last bits.
    """
    made = Figure(figsize=(width, height))
    FigureCanvasAgg(made)
    return made


_raster_dpi: ContextVar[int | None] = ContextVar("raster_dpi", default=None)


@contextmanager
def as_pixels(dpi: int) -> Iterator[None]:
    """Let :func:`svg_uri` give PNG instead, for what cannot read SVG."""
    token = _raster_dpi.set(dpi)
    try:
        yield
    finally:
        _raster_dpi.reset(token)


def svg_uri(made: Figure) -> str:
    """Return a figure as an SVG data URI without date or creator; as PNG inside of :func:`as_pixels`."""
    if (dpi := _raster_dpi.get()) is not None:
        with style():
            return png_uri(pixels(made, dpi), 256)
    buffer = io.BytesIO()
    with style():  # ids of clip paths come from the salt that is set while saving
        made.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def png_uri(pixels: np.ndarray, n_colours: int = 128) -> str:
    """Return an (h, w, 3) uint8 picture as a PNG data URI with a palette.

    Examples
    --------
    >>> png_uri(np.full((2, 2, 3), 255, dtype=np.uint8))[:22]
    'data:image/png;base64,'
    """
    picture = Image.fromarray(np.ascontiguousarray(pixels)).quantize(n_colours, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def pixels(made: Figure, dpi: int) -> np.ndarray:
    """Return a figure as an (h, w, 3) uint8 picture on white."""
    made.set_dpi(dpi)
    made.patch.set_facecolor("white")
    canvas = FigureCanvasAgg(made)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def ramp_uri() -> str:
    """Return the signed colour scale as a narrow picture."""
    return png_uri((255 * SIGNED(np.tile(np.linspace(0, 1, 240), (12, 1)))[..., :3]).round().astype(np.uint8))
