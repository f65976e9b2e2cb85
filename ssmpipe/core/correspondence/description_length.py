"""Spectral objectives: functions of the eigenvalues of the cohort's covariance."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def description_length(eigenvalues: Floats, lambda_cut: float) -> float:
    """Return ``sum phi(lambda_m)``, ``phi = 1 + log(l / l_cut)`` above ``l_cut`` and ``l / l_cut`` below.

    Parameters
    ----------
    eigenvalues : (n,) float64
        Of the covariance [mm^2]; rounding below zero counts as zero.
    lambda_cut : float
        Threshold [mm^2] below which a mode counts as noise.

    Returns
    -------
    float
        Description length [nat] (Thodberg 2003; Li 2015, [1.12]).

    Examples
    --------
    >>> description_length(np.array([np.e, 1.0, 0.5]), 1.0)
    3.5
    """
    ratio = np.maximum(eigenvalues, 0.0) / lambda_cut
    return float(np.where(ratio >= 1.0, 1.0 + np.log(np.maximum(ratio, 1.0)), ratio).sum())


def description_length_slope(eigenvalues: Floats, lambda_cut: float) -> Floats:
    """Return ``phi'(lambda_m)``: ``1 / max(lambda_m, lambda_cut)``.

    Examples
    --------
    >>> description_length_slope(np.array([4.0, 0.1]), 1.0)
    array([0.25, 1.  ])
    """
    return np.asarray(1.0 / np.maximum(eigenvalues, lambda_cut), dtype=np.float64)


def automatic_lambda_cut(size: float) -> float:
    """Return the threshold ``(size / 1000)^2``: variation below a thousandth of the size counts as noise.

    Parameters
    ----------
    size : float
        Root mean square distance of the mean shape's points from their centroid [mm].

    Returns
    -------
    float
        [mm^2]. The printed rule [1.13] of the thesis is not a squared length and changes with the landmark density.

    Examples
    --------
    >>> automatic_lambda_cut(40.0)
    0.0016
    """
    return (size / 1000.0) ** 2
