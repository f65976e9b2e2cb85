"""How large a difference between groups is, in units of the variation inside of them."""

from __future__ import annotations

import numpy as np
from scipy import optimize, stats
from scipy.special import gammaln

from ssmpipe.core.arrays import Floats


def cohen_d(difference: Floats, residuals: Floats, degrees_of_error: int) -> Floats:
    """Return differences of means over the standard deviation inside of the groups (Cohen 1988).

    Parameters
    ----------
    difference : (k,) float64
    residuals : (n, k) float64
        Rows less the mean of their group (and less the covariates).
    degrees_of_error : int

    Returns
    -------
    (k,) float64
        NaN where nothing varies.

    Examples
    --------
    >>> cohen_d(np.array([2.0]), np.array([[1.0], [-1.0], [1.0], [-1.0]]), 4)
    array([2.])
    """
    spread = np.sqrt((residuals**2).sum(axis=0) / degrees_of_error)
    return np.where(spread > 0, difference / np.where(spread > 0, spread, 1.0), np.nan)


def hedges_g(d: Floats, degrees_of_error: int) -> Floats:
    """Return Cohen's d without its bias in small samples (Hedges 1981, eq. 6e, exact factor).

    Examples
    --------
    >>> hedges_g(np.array([1.0]), 10).round(4)
    array([0.9227])
    """
    half = degrees_of_error / 2
    if half <= 0.5:
        return np.full_like(d, np.nan)
    return np.asarray(d * np.exp(gammaln(half) - gammaln(half - 0.5)) / np.sqrt(half))


def effect_interval(g: Floats, n_a: int, n_b: int | None, level: float = 0.95) -> tuple[Floats, Floats]:
    """Return the confidence interval of a standardized difference (Hedges and Olkin 1985, large-sample variance).

    Parameters
    ----------
    g : (k,) float64
    n_a, n_b : int
        Independent subjects of the groups, several bones of one subject counting once; ``n_b`` is None for ``n_a`` pairs.
    level : float

    Examples
    --------
    >>> low, high = effect_interval(np.array([0.0]), 50, 50)
    >>> high.round(3)
    array([0.392])
    """
    variance, total = (1 / n_a, n_a) if n_b is None else (1 / n_a + 1 / n_b, n_a + n_b)
    half = stats.norm.ppf(0.5 + level / 2) * np.sqrt(variance + g**2 / (2 * total))
    return g - half, g + half


def mahalanobis(difference: Floats, residuals: Floats, degrees_of_error: int) -> float:
    """Return the Mahalanobis distance between two means, by the covariance inside of the groups [standard deviations].

    Parameters
    ----------
    difference : (k,) float64
    residuals : (n, k) float64
    degrees_of_error : int
        NaN when it is less than ``k``: the covariance cannot be inverted.

    Examples
    --------
    >>> mahalanobis(np.array([3.0, 4.0]), 2.0 * np.array([[1.0, 1], [-1, 1], [1, -1], [-1, -1]]), 4)
    2.5
    """
    if degrees_of_error < len(difference):
        return float("nan")
    covariance = residuals.T @ residuals / degrees_of_error
    return float(np.sqrt(difference @ np.linalg.solve(covariance, difference)))


def smallest_detectable(n_a: int, n_b: int, alpha: float = 0.05, power: float = 0.8) -> float:
    """Return the standardized difference that one two-sided t test of two groups finds with the given power.

    Parameters
    ----------
    n_a, n_b : int
        Independent subjects of the groups; NaN with fewer than two in all beyond the groups.
    alpha, power : float

    Examples
    --------
    >>> round(smallest_detectable(17, 17), 2)
    0.99
    """
    degrees = n_a + n_b - 2
    if degrees < 1:
        return float("nan")
    limit, root = stats.t.ppf(1 - alpha / 2, degrees), np.sqrt(n_a * n_b / (n_a + n_b))

    def lack(d: float) -> float:
        return float(stats.nct.sf(limit, degrees, d * root) - power)

    return float(optimize.brentq(lack, 1e-6, (limit + 10) * 4 / root))
