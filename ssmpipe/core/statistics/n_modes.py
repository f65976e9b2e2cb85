"""How many modes of variation to keep: parallel analysis and share of variance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats


@dataclass(frozen=True, eq=False)
class ModeCount:
    """How many modes are kept, and why.

    Parameters
    ----------
    kept : int
    by_parallel_analysis, by_variance, allowed : int
        Modes that stand out from shuffled data; that hold the asked share of the variance; that the sample size allows.
    thresholds : (n_modes,) float64
        Variance that a mode of shuffled data reaches in 5 % of the shuffles [mm^2].
    """

    kept: int
    by_parallel_analysis: int
    by_variance: int
    allowed: int
    thresholds: Floats


def parallel_analysis(flat: Floats, rng: np.random.Generator, n_shuffles: int = 100, quantile: float = 0.95) -> Floats:
    """Return the variance of the m-th mode that unrelated coordinates reach by chance (Horn 1965; Buja and Eyuboglu 1992).

    Every coordinate is shuffled over the shapes by itself, which keeps its variance and breaks all relations.

    Parameters
    ----------
    flat : (n_S, n_coordinates) float64
    rng : numpy.random.Generator
    n_shuffles : int
    quantile : float

    Returns
    -------
    (n_S - 1,) float64
    """
    centred = flat - flat.mean(axis=0)
    spectra = np.empty((n_shuffles, len(flat) - 1))
    for k in range(n_shuffles):
        shuffled = rng.permuted(centred, axis=0)
        spectra[k] = np.linalg.eigvalsh(shuffled @ shuffled.T / (len(flat) - 1))[::-1][:-1]
    return np.quantile(spectra, quantile, axis=0)


def modes_for_share(variances: Floats, share: float) -> int:
    """Return how many leading modes hold a share of the variance.

    Examples
    --------
    >>> modes_for_share(np.array([6.0, 3.0, 1.0]), 0.9)
    2
    """
    cumulative = np.cumsum(variances) / variances.sum()
    return min(int(np.searchsorted(cumulative, share - 1e-12)) + 1, len(variances))


def modes_to_keep(variances: Floats, thresholds: Floats, degrees_of_error: int, share: float = 0.98) -> ModeCount:
    """Return the larger of both counts, but at most a third of the degrees of error.

    A test in more modes has little power left for each: Hotelling's T2 needs several rows per dimension. The share is high because a
    local difference sits in modes of little variance: of four synthetic cohorts of femora with a cam bump on every second bone, the
    modes that hold 90 % of the variance miss it in all, those that hold 98 % show it in two (docs/compare.md).

    Parameters
    ----------
    variances : (n_modes,) float64
        Decreasing.
    thresholds : (>= n_modes,) float64
        Of :func:`parallel_analysis`.
    degrees_of_error : int
    share : float

    Examples
    --------
    >>> modes_to_keep(np.array([6.0, 3.0, 0.9, 0.1]), np.array([2.0, 2.0, 2.0, 2.0]), 30, share=0.9).kept
    2
    """
    above = variances > thresholds[: len(variances)]
    parallel = int(len(above) if above.all() else np.argmin(above))
    by_share = modes_for_share(variances, share)
    allowed = max(1, degrees_of_error // 3)
    return ModeCount(max(1, min(max(parallel, by_share), allowed)), parallel, by_share, allowed, thresholds)
