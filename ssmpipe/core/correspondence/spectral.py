"""Spectral objectives by name: value and slope as functions of the eigenvalues of the covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.description_length import description_length, description_length_slope

Objective = Literal["description-length", "log-determinant", "trace"]


@dataclass(frozen=True)
class SpectralFunction:
    """``f = sum phi(lambda_m)``.

    Parameters
    ----------
    value : callable
        Eigenvalues (n,) to ``f``.
    slope : callable
        Eigenvalues (n,) to ``phi'`` (n,).
    curvature : callable
        Eigenvalues (n,) to ``phi''`` (n,).
    shift : float
        Positive if ``f = log det(G + shift I)`` up to the null direction, which a Cholesky factor gives too.
    """

    value: Callable[[Floats], float]
    slope: Callable[[Floats], Floats]
    curvature: Callable[[Floats], Floats]
    shift: float = 0.0

    def slope_differences(self, eigenvalues: Floats) -> Floats:
        """Return the (n, n) divided differences of ``phi'``, ``phi''`` where eigenvalues coincide (Daleckii and Krein 1965).

        Examples
        --------
        >>> spectral_function("log-determinant", 1.0).slope_differences(np.array([1.0, 0.0]))
        array([[-0.25, -0.5 ],
               [-0.5 , -1.  ]])
        """
        slope, curvature = self.slope(eigenvalues), self.curvature(eigenvalues)
        gap = eigenvalues[:, None] - eigenvalues[None]
        scale = np.maximum(np.abs(eigenvalues[:, None]), np.abs(eigenvalues[None]))
        same = np.abs(gap) <= 1e-9 * scale
        difference = (slope[:, None] - slope[None]) / np.where(same, 1.0, gap)
        return np.where(same, 0.5 * (curvature[:, None] + curvature[None]), difference)


def spectral_function(name: Objective, lambda_cut: float) -> SpectralFunction:
    """Return a spectral objective.

    Parameters
    ----------
    name : {"description-length", "log-determinant", "trace"}
        ``description-length``: [1.12]. ``log-determinant``: ``sum log(lambda_m + lambda_cut)`` (Kotcheff and Taylor 1998).
        ``trace``: ``sum lambda_m / lambda_cut``, the total variance.
    lambda_cut : float
        Threshold, floor or unit [mm^2].

    Examples
    --------
    >>> spectral_function("trace", 2.0).value(np.array([4.0, 2.0]))
    3.0
    """
    if name == "description-length":
        return SpectralFunction(
            lambda values: description_length(values, lambda_cut),
            lambda values: description_length_slope(values, lambda_cut),
            lambda values: np.where(values > lambda_cut, -1.0 / np.maximum(values, lambda_cut) ** 2, 0.0),
        )
    if name == "log-determinant":
        return SpectralFunction(
            lambda values: float(np.log(np.maximum(values, 0.0) + lambda_cut).sum()),
            lambda values: np.asarray(1.0 / (np.maximum(values, 0.0) + lambda_cut)),
            lambda values: np.asarray(-1.0 / (np.maximum(values, 0.0) + lambda_cut) ** 2),
            lambda_cut,
        )
    return SpectralFunction(
        lambda values: float(values.sum() / lambda_cut),
        lambda values: np.full(len(values), 1.0 / lambda_cut),
        lambda values: np.zeros(len(values)),
    )
