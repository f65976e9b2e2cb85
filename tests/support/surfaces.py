"""Small spline cohorts for tests of the engine."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface


def bump(
    centre: tuple[float, float], height: float, *, side: float = 60.0, width: float = 8.0, n: int = 24
) -> BSplineSurface:
    """Return a plane with one Gaussian bump (the plane-bump family of Li 2015, [2.24])."""
    t = np.linspace(0, 1, 4 * n) * side
    x, y = np.meshgrid(t, t, indexing="ij")
    z = height * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * width**2))
    return fit_surface(np.stack([x, y, z], axis=-1), n_control=(n, n))


def bumps(n: int, seed: int = 0) -> list[BSplineSurface]:
    """Return a cohort whose bump moves in x and y and changes height."""
    rng = np.random.default_rng(seed)
    return [bump(tuple(rng.uniform(22, 38, 2)), rng.uniform(15, 25)) for _ in range(n)]


def taylor_rate(value, gradient, x, direction, steps=(1e-2, 1e-3, 1e-4, 1e-5)) -> float:
    """Return the smallest pairwise order of ``|f(x + h d) - f(x) - h g'd|``; 2 for an exact gradient.

    Differences are taken around ``x`` symmetrically corrected: only the remainder counts. Remainders at rounding level end the sweep.
    """
    f0, slope = value(x), float(gradient @ direction)
    remainder = [abs(value(x + h * direction) - f0 - h * slope) for h in steps]
    floor = 1e-12 * max(1.0, abs(f0))
    rates = []
    for k in range(1, len(steps)):
        if remainder[k] < floor:
            break
        rates.append(np.log(remainder[k - 1] / remainder[k]) / np.log(steps[k - 1] / steps[k]))
    assert len(rates) >= 2, f"too few usable steps: {remainder}"
    return min(rates)


def wrapped_samples(kind: str, n: int = 81, *, phase: float = 0.0, bump: float = 1.0, size: float = 10.0):
    """Return (n, n, 3) samples of a tube, cone or closed surface with a bump; ``phase`` is where u starts [turns]."""
    u = np.linspace(0, 1, n)
    u, v = np.meshgrid(u, u, indexing="ij")
    angle = 2 * np.pi * (u + phase)
    lift = 0.25 * bump * np.exp(-((np.mod(angle - 2, 2 * np.pi) - np.pi) ** 2) / 0.8 - (v - 0.5) ** 2 / 0.1)
    if kind == "tube":
        r = 1 + lift
        samples = np.stack([r * np.cos(angle), 0.9 * r * np.sin(angle), 3 * v], -1)
    else:
        polar = (np.pi if kind == "closed" else np.pi / 2) * (1 - v)
        r = 1 + lift * np.sin(polar)
        x, y = r * np.sin(polar) * np.cos(angle), 0.9 * r * np.sin(polar) * np.sin(angle)
        samples = np.stack([x, y, 1.2 * r * np.cos(polar)], -1)
    samples *= size
    samples[-1] = samples[0]
    if kind != "tube":
        samples[:, -1] = samples[0, -1]
    if kind == "closed":
        samples[:, 0] = samples[0, 0]
    return samples


def wrapped(kind: str, *, degree: int = 2, n: int = 24, smooth: bool = True, **options) -> BSplineSurface:
    """Return the spline through :func:`wrapped_samples`."""
    samples = wrapped_samples(kind, **options)
    return fit_surface(samples, degree=(degree, degree), n_control=(n, n), smooth=smooth)
