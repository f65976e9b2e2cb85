"""Many tests at once: false discovery rate, and chance of a single false alarm."""

from __future__ import annotations

import numpy as np
from scipy.stats import false_discovery_control

from ssmpipe.core.arrays import Floats


def false_discovery_rate(p: Floats) -> Floats:
    """Return q values: the false discovery rate at which each test is a discovery (Benjamini and Hochberg 1995).

    Examples
    --------
    >>> false_discovery_rate(np.array([0.01, 0.04, 0.03]))
    array([0.03, 0.04, 0.04])
    """
    return np.asarray(false_discovery_control(p, method="bh"))


def holm(p: Floats) -> Floats:
    """Return p values that hold for all tests together (Holm 1979); any dependence.

    Examples
    --------
    >>> holm(np.array([0.01, 0.04, 0.03]))
    array([0.03, 0.06, 0.06])
    """
    order = np.argsort(p, kind="stable")
    adjusted = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.minimum(adjusted, 1.0)
    return out


def family_wise(observed: Floats, largest: Floats, tolerance: float = 1e-9) -> Floats:
    """Return p values that hold for all tests together: how often the largest statistic of a draw reaches each (max-T).

    Westfall and Young (1993), single step. It uses the correlation of neighbours, which Bonferroni does not.

    Parameters
    ----------
    observed : (n_tests,) float64
        Statistics with the same distribution under the null hypothesis.
    largest : (n_draws,) float64
        Largest of the statistics in every draw.

    Examples
    --------
    >>> family_wise(np.array([3.0, 1.0]), np.array([0.5, 2.0, 4.0]))
    array([0.5 , 0.75])
    """
    below = np.searchsorted(np.sort(largest), observed * (1.0 - tolerance), side="left")
    return np.asarray((1.0 + len(largest) - below) / (1.0 + len(largest)), dtype=np.float64)
