"""Sheets and tubes that are cut at different places from surfaces that correspond point by point."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface

DISK = ((0, 0), (0, -1), (1, 0), (1, -1))
TUBE = ((1, 0), (1, -1))
RATIOS = np.array([0.9, 1.1, 1.0, 0.95, 1.05])
CUTS = np.array([[0.0, 1.0], [0.06, 0.97], [-0.05, 1.06], [0.03, 1.04], [-0.04, 0.95]])
"""Where each shape begins and ends, in the coordinates that all share."""


def sheet(x, y, ratio):
    height = 0.3 * np.sin(2.5 * x + 1.0) * np.cos(3.5 * y) + ratio * 0.25 * np.exp(
        -20 * ((x - 0.4) ** 2 + (y - 0.6) ** 2)
    )
    return 50.0 * np.stack([x, y, height], axis=-1)


def tube(x, y, ratio):
    angle = 2 * np.pi * x
    radius = 1 + 0.3 * ratio * np.exp(-((np.mod(angle - 2, 2 * np.pi) - np.pi) ** 2) / 0.8 - (y - 0.5) ** 2 / 0.05)
    radius = radius * (1.3 - 0.5 * y)
    return 10.0 * np.stack([radius * np.cos(angle), 0.8 * radius * np.sin(angle), 4 * y], axis=-1)


SURFACES = {"disk": (sheet, DISK, "fixed"), "tube": (tube, TUBE, "periodic")}


def cut(kind, low, high, ratio, seam=0.0):
    """Return a spline whose parameters run over its own part of the shared coordinates; a tube begins at ``seam`` around it."""
    u, v = np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61), indexing="ij")
    along = low + (high - low) * v
    across = low + (high - low) * u if kind == "disk" else u + seam
    samples = SURFACES[kind][0](across, along, ratio)
    if kind == "tube":
        samples[-1] = samples[0]
    return fit_surface(samples, n_control=(24, 24))


def cut_cohort(kind, seams=(0.0,) * 5) -> list[BSplineSurface]:
    """Return the five shapes of :data:`CUTS`."""
    return [cut(kind, *c, r, s) for c, r, s in zip(CUTS, RATIOS, seams, strict=True)]
