"""Cohorts of curves and surfaces with known covariance, and reparameterizations, for tests of the continuous forms."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import clamped_uniform_knots, greville
from ssmpipe.core.spline.surface import BSplineSurface


def line_bumps(n_shapes: int = 4, n_control: int = 12, degree: int = 2, tilt: float = 0.0) -> list[BSplineCurve]:
    """Return plane curves ``y = bump`` whose bump moves along x; with ``tilt`` the ends differ too."""
    knots = clamped_uniform_knots(n_control, degree)
    x = 10 * greville(knots, degree)
    centres = np.linspace(3.5, 6.5, n_shapes)
    heights = [3 * np.exp(-((x - c) ** 2)) + tilt * (c - 5) * x for c in centres]
    return [BSplineCurve(degree, knots, np.stack([x, y], axis=1)) for y in heights]


def plane_bumps(n_shapes: int = 4, n_control: int = 11, degree: int = 2, tilt: float = 0.0) -> list[BSplineSurface]:
    """Return planes with one Gaussian bump that moves along x; with ``tilt`` the boundaries differ too."""
    knots = clamped_uniform_knots(n_control, degree)
    g = 10 * greville(knots, degree)
    x, y = np.meshgrid(g, g, indexing="ij")
    centres = np.linspace(3.5, 6.5, n_shapes)
    heights = [3 * np.exp(-0.4 * ((x - c) ** 2 + (y - 5) ** 2)) + tilt * (c - 5) * (x + y) for c in centres]
    return [BSplineSurface((degree, degree), knots, knots, np.stack([x, y, z], axis=-1)) for z in heights]


def random_curves(
    rng: np.random.Generator, n_shapes: int, n_control: int, degree: int, dim: int = 3
) -> list[BSplineCurve]:
    knots = clamped_uniform_knots(n_control, degree)
    return [BSplineCurve(degree, knots, rng.normal(size=(n_control, dim))) for _ in range(n_shapes)]


def random_surfaces(
    rng: np.random.Generator, n_shapes: int, n_control: tuple[int, int], degree: tuple[int, int]
) -> list[BSplineSurface]:
    knots = [clamped_uniform_knots(n, p) for n, p in zip(n_control, degree, strict=True)]
    return [BSplineSurface(degree, knots[0], knots[1], rng.normal(size=(*n_control, 3))) for _ in range(n_shapes)]


def random_map(rng: np.random.Generator, n_control: int, degree: int) -> BSplineCurve:
    """Return an increasing map of the unit interval, with uneven knots."""
    inner = np.sort(rng.uniform(0.1, 0.9, n_control - degree - 1))
    knots = np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])
    steps = rng.uniform(0.3, 1.0, n_control - 1) * np.diff(greville(knots, degree))
    values = np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])
    values[-1] = 1.0
    return BSplineCurve(degree, knots, values[:, None])


def random_square_map(rng: np.random.Generator, n_control: int, degree: int, size: float = 0.05) -> BSplineSurface:
    """Return a map of the unit square onto itself, the identity on its boundary."""
    knots = clamped_uniform_knots(n_control, degree)
    g = greville(knots, degree)
    control = np.stack(np.meshgrid(g, g, indexing="ij"), axis=-1)
    control[1:-1, 1:-1] += size * rng.uniform(-1, 1, size=(n_control - 2, n_control - 2, 2))
    return BSplineSurface((degree, degree), knots, knots, control)


def slope(counts: list[int], errors: list[float]) -> float:
    """Return the order of convergence: the slope of the error over the count, both logarithmic."""
    return -float(np.polyfit(np.log(counts), np.log(errors), 1)[0])
