"""Hotelling's T2 for two groups and Pillai's trace for more, with p values by permutation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.statistics.covariates import Contrast
from ssmpipe.core.statistics.false_discovery import family_wise
from ssmpipe.core.statistics.permutation import Draws, permutation_p

_TIE = 1e-9  # relative; a rearrangement that gives the observed groups again must count as a tie


@dataclass(frozen=True, eq=False)
class PermutationTest:
    """Tests of several variables against the same draws.

    Parameters
    ----------
    statistic : (n_tests,) float64
        Pillai's trace, in [0, r]; for one dimension the share of variance that the groups explain.
    p : (n_tests,) float64
    p_family : (n_tests,) float64
        Corrected for all tests together (max-T).
    """

    statistic: Floats
    p: Floats
    p_family: Floats


def permutation_test(values: Floats, contrast: Contrast, draws: Draws, *, whole: bool = False) -> PermutationTest:
    """Test every variable of a sample for differences between groups.

    Residuals of the nuisance part are rearranged and regressed on it again (Freedman and Lane 1983; recommended by Winkler et al.
    2014). Without covariates this is the plain, exact permutation of labels.

    Parameters
    ----------
    values : (n, n_tests, d) float64
        Variables of ``d`` dimensions, tested jointly over the dimensions.
    contrast : Contrast
    draws : Draws
    whole : bool, default=False
        Whether squared distances are compared (sum over the dimensions, Anderson 2001) instead of Mahalanobis distances; then
        ``d`` may exceed the number of rows.

    Returns
    -------
    PermutationTest
        A variable without any variation has no statistic and no p value (NaN).
    """
    residuals = contrast.residuals(values)
    noise = np.abs(residuals).max(axis=(0, 2)) <= 1e-12 * np.abs(values).max(axis=(0, 2))
    residuals = np.where(noise[None, :, None], 0.0, residuals)
    white, alive = _standardized(residuals, whole=whole)
    n_rows, n_tests, n_dimensions = white.shape
    flat = white.reshape(n_rows, -1)
    observed = np.where(alive, _traces(flat, contrast.tested[None], contrast.nuisance[None], n_tests, whole)[0], np.nan)
    n_columns = contrast.tested.shape[1] + (0 if contrast.constant_only else contrast.nuisance.shape[1])
    matrices = 1 if whole or contrast.constant_only else n_dimensions
    step = max(1, int(4e6) // (n_columns * n_tests * n_dimensions * matrices))
    as_large = np.zeros(n_tests, dtype=np.int64)
    largest = np.empty(len(draws))
    for start in range(0, len(draws), step):
        stop = min(start + step, len(draws))
        tested, nuisance = (draws.moved(m, start, stop) for m in (contrast.tested, contrast.nuisance))
        traces = _traces(flat, tested, nuisance, n_tests, whole)
        as_large += (traces >= observed * (1.0 - _TIE)).sum(axis=0)
        largest[start:stop] = np.where(alive, traces, -np.inf).max(axis=1, initial=-np.inf)
    return PermutationTest(
        observed,
        permutation_p(observed, as_large, len(draws)),
        np.where(alive, family_wise(observed, largest), np.nan),
    )


def _standardized(residuals: Floats, *, whole: bool) -> tuple[Floats, Bools]:
    """Return residuals whose cross product is the identity per test (``whole``: whose trace is one), and which tests vary."""
    if whole:
        total = (residuals**2).sum(axis=(0, 2))
        alive = total > 0
        return residuals / np.sqrt(np.where(alive, total, 1.0))[None, :, None], alive
    products = np.einsum("ncd,nce->cde", residuals, residuals)
    values, vectors = np.linalg.eigh(products)
    keep = values > 1e-10 * np.maximum(values[:, -1:], 1e-300)
    factors = vectors * np.where(keep, 1.0 / np.sqrt(np.where(keep, values, 1.0)), 0.0)[:, None, :]
    return np.einsum("ncd,cde->nce", residuals, factors), keep.any(axis=1)


def _traces(flat: Floats, tested: Floats, nuisance: Floats, n_tests: int, whole: bool) -> Floats:
    """Return Pillai's trace per draw and test, (b, n_tests); ``flat`` is (n, n_tests * d), the bases are (b, n, r) and (b, n, q)."""
    explained = _coordinates(flat, tested, n_tests)
    if nuisance.shape[2] <= 1:  # a constant stays a constant, so that the total never changes
        return np.asarray((explained**2).sum(axis=(1, 3)))
    taken = _coordinates(flat, nuisance, n_tests)
    if whole:
        return np.asarray((explained**2).sum(axis=(1, 3)) / (1.0 - (taken**2).sum(axis=(1, 3))))
    if flat.shape[1] == n_tests:
        return np.asarray((explained**2).sum(axis=(1, 3)) / (1.0 - (taken**2).sum(axis=(1, 3))))
    left = np.eye(explained.shape[3]) - np.einsum("bqcd,bqce->bcde", taken, taken)
    solved = np.linalg.solve(left, np.moveaxis(explained, 1, 3))
    return np.asarray(np.einsum("brcd,bcdr->bc", explained, solved))


def _coordinates(flat: Floats, basis: Floats, n_tests: int) -> Floats:
    """Return the (b, k, n_tests, d) coefficients of the variables along the columns of each draw's basis."""
    n_draws, n_rows, n_columns = basis.shape
    rows = np.ascontiguousarray(np.moveaxis(basis, 2, 1)).reshape(-1, n_rows)
    return np.asarray((rows @ flat).reshape(n_draws, n_columns, n_tests, -1))


def t_squared(trace: float, degrees_of_error: int) -> float:
    """Return Hotelling's T2 of a contrast with one column from Pillai's trace.

    Examples
    --------
    >>> t_squared(0.5, 10)
    10.0
    """
    return degrees_of_error * trace / (1.0 - trace) if trace < 1 else float("inf")


def parametric_p(trace: float, n_dimensions: int, n_columns: int, degrees_of_error: int) -> float:
    """Return the p value of Pillai's trace by the F distribution: exact for one column (Hotelling), else approximate.

    It supposes independent, normal rows of equal covariance; NaN when there are more dimensions than degrees of error.

    Parameters
    ----------
    trace : float
    n_dimensions : int
    n_columns : int
        Of the tested contrast: number of groups less one.
    degrees_of_error : int
    """
    s = min(n_dimensions, n_columns)
    m = (abs(n_dimensions - n_columns) - 1) / 2
    n = (degrees_of_error - n_dimensions - 1) / 2
    if n < 0 or not 0 <= trace < s:
        return float("nan")
    ratio = (2 * n + s + 1) / (2 * m + s + 1) * trace / (s - trace)
    return float(stats.f.sf(ratio, s * (2 * m + s + 1), s * (2 * n + s + 1)))
