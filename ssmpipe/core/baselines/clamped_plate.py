"""Reparameterization of the unit square by concatenated clamped-plate splines, the baseline of the direct spline map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import xlogy

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.baselines.concatenation import Concatenation, Family, optimize_concatenation
from ssmpipe.core.errors import FoldoverError
from ssmpipe.core.result import Result
from ssmpipe.core.spline.surface import BSplineSurface

LARGEST_SHARE = 0.95
Search = Literal["plane", "direction"]


@dataclass(frozen=True)
class ClampedPlateWarp:
    """Displacement ``a h(|u - c| / w)`` inside a disk, ``h = 1 - r^2 + r^2 log r^2`` (Li 2015, [B.2, B.3]).

    ``h`` and its slope vanish on the rim, so the map is C1. Its Jacobian ``1 + a . grad h`` is positive exactly for
    ``|a| < w e / 4`` [B.4]: the steepest slope of ``h`` is ``4 / e``, at ``r = 1 / e``.

    Parameters
    ----------
    centre : (float, float)
    width : float
        Radius of the disk.
    displacement : (float, float)
        ``a``, the displacement of the centre; 0 is the identity.

    Raises
    ------
    FoldoverError
        If ``|a| >= w e / 4``, or the disk leaves the unit square, so that the boundary would move.

    Examples
    --------
    >>> ClampedPlateWarp((0.5, 0.5), 0.5, (0.1, 0.0))(np.array([[0.5, 0.5], [0.0, 0.5], [1.0, 1.0]]))
    array([[0.6, 0.5],
           [0. , 0.5],
           [1. , 1. ]])
    """

    centre: tuple[float, float]
    width: float
    displacement: tuple[float, float]

    def __post_init__(self) -> None:
        length, bound = float(np.hypot(*self.displacement)), largest_displacement(self.width)
        if not length < bound:
            raise FoldoverError(
                f"a clamped-plate warp of width {self.width:.4g} folds when displaced by {length:.4g}",
                f"stay below {bound:.4g}",
            )
        if self.width > min(min(c, 1.0 - c) for c in self.centre) + 1e-12:
            raise FoldoverError(
                f"a disk of radius {self.width:.4g} around ({self.centre[0]:.4g}, {self.centre[1]:.4g}) "
                "leaves the unit square"
            )

    def __call__(self, parameters: Floats) -> Floats:
        """Map (n, 2) parameters."""
        offset = parameters - np.asarray(self.centre)
        square = np.einsum("nk,nk->n", offset, offset) / self.width**2
        inside = square < 1.0
        height = np.where(inside, 1.0 - square + xlogy(square, square), 0.0)
        return np.asarray(parameters + height[:, None] * np.asarray(self.displacement))

    def jacobian(self, parameters: Floats) -> Floats:
        """Return ``det dD/du`` at (n, 2) parameters; positive."""
        offset = parameters - np.asarray(self.centre)
        square = np.einsum("nk,nk->n", offset, offset) / self.width**2
        log = np.log(np.where((square > 0) & (square < 1.0), square, 1.0))
        # h is a function of r^2 with slope log r^2, and r^2 has the gradient 2 offset / w^2
        return np.asarray(1.0 + 2.0 * log * (offset @ np.asarray(self.displacement)) / self.width**2)


def largest_displacement(width: float) -> float:
    """Return ``w e / 4``, the displacement from which on a warp folds (Li 2015, [B.4]).

    Examples
    --------
    >>> round(largest_displacement(1.0), 6)
    0.67957
    """
    return width * float(np.e) / 4.0


def optimize(
    splines: Sequence[BSplineSurface],
    *,
    grid: tuple[int, ...],
    lambda_cut: float,
    reference: int,
    n_warps: int,
    rng: np.random.Generator,
    time_budget_s: float | None = None,
    max_evaluations: int | None = None,
    target: float | None = None,
    clock: Callable[[], float] | None = None,
    widths: tuple[float, float] = (0.8, 1.0),
    search: Search = "direction",
) -> Result[Concatenation]:
    """Minimize the description length of surfaces by concatenated clamped-plate warps (Li 2015, sec. 2.3.2, appendix B).

    Every step draws a shape, a centre (uniform in the square) and a width, and finds the displacement within the disk in
    which the warp is a bijection.

    Parameters
    ----------
    splines : sequence of BSplineSurface
    grid, lambda_cut, reference, n_warps, rng, time_budget_s, max_evaluations, target, clock
        As in :func:`ssmpipe.core.baselines.concatenation.optimize_concatenation`.
    widths : (float, float), default=(0.8, 1)
        Range of the widths, as shares of the centre's distance from the boundary.
    search : {"direction", "plane"}, default="direction"
        ``direction``: a random direction, its length by Brent's bounded method; per second it gets further. ``plane``: both
        components of the displacement by Nelder and Mead's simplex.
    """

    def draw(generator: np.random.Generator) -> Floats:
        centre = generator.uniform(0.0, 1.0, 2)
        width = float(np.minimum(centre, 1.0 - centre).min() * generator.uniform(*widths))
        return np.array([*centre, width, generator.uniform(0.0, 2.0 * np.pi)])

    family = Family(2, draw, _inside, _warp, _simplex if search == "plane" else _brent)
    return optimize_concatenation(
        splines,
        family,
        grid=grid,
        lambda_cut=lambda_cut,
        reference=reference,
        n_warps=n_warps,
        rng=rng,
        time_budget_s=time_budget_s,
        max_evaluations=max_evaluations,
        target=target,
        clock=clock,
    )


def _inside(drawn: Floats, parameters: Floats) -> Ints:
    offset = parameters - drawn[:2]
    return np.flatnonzero(np.einsum("nk,nk->n", offset, offset) < drawn[2] ** 2)


def _warp(drawn: Floats, magnitude: Floats) -> ClampedPlateWarp:
    """Magnitudes are shares of the largest displacement; those beyond the bound are drawn back to it."""
    length = float(np.hypot(*magnitude))
    scale = largest_displacement(float(drawn[2])) * min(1.0, LARGEST_SHARE / max(length, 1e-300))
    a = magnitude * scale
    return ClampedPlateWarp((float(drawn[0]), float(drawn[1])), float(drawn[2]), (float(a[0]), float(a[1])))


def _simplex(value: Callable[[Floats], float], drawn: Floats) -> object:
    turn = np.array([np.cos(drawn[3]), np.sin(drawn[3])])
    corners = 0.2 * np.array([np.zeros(2), turn, [-turn[1], turn[0]]])
    options: Any = {"initial_simplex": corners, "maxfev": 30, "xatol": 5e-3, "fatol": 0.0}
    return minimize(value, np.zeros(2), method="Nelder-Mead", options=options)


def _brent(value: Callable[[Floats], float], drawn: Floats) -> object:
    turn = np.array([np.cos(drawn[3]), np.sin(drawn[3])])
    return minimize_scalar(
        lambda s: value(s * turn),
        bounds=(-LARGEST_SHARE, LARGEST_SHARE),
        method="bounded",
        options={"xatol": 1e-2, "maxiter": 15},
    )
