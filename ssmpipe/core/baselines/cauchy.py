"""Reparameterization of curves by concatenated Cauchy kernels, the baseline of the direct spline map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.baselines.concatenation import Concatenation, Family, optimize_concatenation
from ssmpipe.core.errors import FoldoverError
from ssmpipe.core.result import Result
from ssmpipe.core.spline.curve import BSplineCurve

LARGEST_LOG_DENSITY = float(np.log(20.0))


@dataclass(frozen=True)
class CauchyWarp:
    """Cumulative distribution of a uniform density with one Cauchy kernel on top (Davies et al. 2008; Li 2015, [A.1]).

    The density ``1 + A / (1 + ((u - c) / w)^2)`` is positive for ``A > -1``, and its integral, scaled to end in 1, is an
    increasing map of the unit interval onto itself with known arctangents.

    Parameters
    ----------
    centre : float
        ``c``, in [0, 1].
    width : float
        ``w``, positive.
    magnitude : float
        ``A``; 0 is the identity, positive spreads points away from the centre, negative gathers them.

    Raises
    ------
    FoldoverError
        If ``A <= -1``.

    Examples
    --------
    >>> CauchyWarp(0.5, 0.1, 3.0)(np.array([[0.0], [0.4], [0.5], [1.0]])).round(3).ravel()
    array([0.   , 0.316, 0.5  , 1.   ])
    """

    centre: float
    width: float
    magnitude: float

    def __post_init__(self) -> None:
        if not self.magnitude > -1.0:
            raise FoldoverError(
                f"a Cauchy kernel of magnitude {self.magnitude:.4g} makes the density negative", "stay above -1"
            )

    def __call__(self, parameters: Floats) -> Floats:
        """Map (n, 1) parameters."""
        start = np.arctan((0.0 - self.centre) / self.width)
        end = np.arctan((1.0 - self.centre) / self.width)
        factor = self.magnitude * self.width
        bend = np.arctan((parameters - self.centre) / self.width) - start
        moved = (parameters + factor * bend) / (1.0 + factor * (end - start))
        return np.asarray(np.clip(moved, 0.0, 1.0))

    def derivative(self, parameters: Floats) -> Floats:
        """Return ``dD/du`` at (n, 1) parameters; positive."""
        start = np.arctan((0.0 - self.centre) / self.width)
        end = np.arctan((1.0 - self.centre) / self.width)
        density = 1.0 + self.magnitude / (1.0 + ((parameters - self.centre) / self.width) ** 2)
        return np.asarray(density / (1.0 + self.magnitude * self.width * (end - start)))


def optimize(
    splines: Sequence[BSplineCurve],
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
    widths: tuple[float, float] = (0.002, 0.02),
) -> Result[Concatenation]:
    """Minimize the description length of curves by concatenated Cauchy kernels (Li 2015, sec. 2.3.1 and appendix A).

    Every step draws a shape, a centre (uniform) and a width (log-uniform), and finds the magnitude by Brent's bounded
    method in ``log(1 + A)`` between minus and plus ``log 20``.

    Parameters
    ----------
    splines : sequence of BSplineCurve
    grid, lambda_cut, reference, n_warps, rng, time_budget_s, max_evaluations, target, clock
        As in :func:`ssmpipe.core.baselines.concatenation.optimize_concatenation`.
    widths : (float, float), default=(0.002, 0.02)
        Range of the kernel widths. Of seven ranges tried on box-bump with 51 landmarks this one fell lowest in 30 s.
    """
    low, high = np.log(widths)

    def draw(generator: np.random.Generator) -> Floats:
        return np.array([generator.uniform(), np.exp(generator.uniform(low, high))])

    family = Family(1, draw, _everywhere, _warp, _brent)
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


def _everywhere(_drawn: Floats, parameters: Floats) -> Ints:
    return np.arange(1, len(parameters) - 1)


def _warp(drawn: Floats, magnitude: Floats) -> CauchyWarp:
    return CauchyWarp(float(drawn[0]), float(drawn[1]), float(np.expm1(magnitude[0])))


def _brent(value: Callable[[Floats], float], _drawn: Floats) -> object:
    return minimize_scalar(
        lambda s: value(np.array([s])),
        bounds=(-LARGEST_LOG_DENSITY, LARGEST_LOG_DENSITY),
        method="bounded",
        options={"xatol": 1e-2, "maxiter": 20},
    )
