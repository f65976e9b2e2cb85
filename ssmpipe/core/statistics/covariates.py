"""What is tested and what is only taken into account: groups, and covariates such as age, sex and size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Contrast:
    """The part of a linear model that is tested, and the part that is not.

    Parameters
    ----------
    tested : (n, r) float64
        Orthonormal columns: what the groups add to the nuisance part.
    nuisance : (n, q) float64
        Orthonormal columns: constant and covariates; none for a test of the differences of pairs against zero.
    """

    tested: Floats
    nuisance: Floats

    @property
    def degrees_of_error(self) -> int:
        """Rows that are left to estimate the variation inside of the groups."""
        return len(self.tested) - self.tested.shape[1] - self.nuisance.shape[1]

    @property
    def constant_only(self) -> bool:
        """Whether there is no covariate: nothing but a constant, or nothing at all, is not tested."""
        return self.nuisance.shape[1] <= 1

    def residuals(self, values: Floats) -> Floats:
        """Return ``values`` (n, ...) without their nuisance part."""
        flat = values.reshape(len(values), -1)
        return np.asarray((flat - self.nuisance @ (self.nuisance.T @ flat)).reshape(values.shape))


def group_contrast(labels: Ints, covariates: Floats | None = None) -> Contrast:
    """Return the contrast of all groups against a common mean.

    Parameters
    ----------
    labels : (n,) int64
        Group of each row, 0 to g - 1, all present.
    covariates : (n, c) float64, optional

    Raises
    ------
    ConfigError
        If the covariates determine each other or the groups.

    Examples
    --------
    >>> contrast = group_contrast(np.array([0, 0, 1, 1]))
    >>> contrast.tested.shape, contrast.degrees_of_error
    ((4, 1), 2)
    """
    nuisance = np.ones((len(labels), 1)) / np.sqrt(len(labels))
    if covariates is not None and covariates.shape[1]:
        centred = covariates - covariates.mean(axis=0)
        centred -= centred.mean(axis=0)  # a calendar year leaves rounding of its own size behind
        spread = np.linalg.norm(centred, axis=0)
        basis = _basis(centred / np.where(spread > 0, spread, 1.0))
        if basis.shape[1] < covariates.shape[1]:
            raise ConfigError(
                f"the {covariates.shape[1]} covariate columns determine each other (rank {basis.shape[1]}), or one is constant",
                "leave one of them out of --covariates",
            )
        nuisance = np.concatenate([nuisance, basis], axis=1)
    indicator = _indicator(labels)
    tested = _basis(indicator - nuisance @ (nuisance.T @ indicator), scale=1.0)
    if tested.shape[1] < indicator.shape[1] - 1:
        raise ConfigError(
            "the covariates determine the groups: their effects cannot be told apart",
            "leave the covariate that differs between the groups by design out of --covariates",
        )
    return Contrast(tested, nuisance)


def pair_contrast(n: int) -> Contrast:
    """Return the contrast of the mean of ``n`` differences against zero.

    Examples
    --------
    >>> pair_contrast(4).tested.ravel()
    array([0.5, 0.5, 0.5, 0.5])
    """
    return Contrast(np.full((n, 1), 1.0 / np.sqrt(n)), np.empty((n, 0)))


def adjusted_means(values: Floats, labels: Ints, covariates: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the mean of every group at the average covariates, and what is left of each row inside of its group.

    One slope for all groups: covariates shift the groups, they do not interact with them.

    Parameters
    ----------
    values : (n, ...) float64
    labels : (n,) int64
    covariates : (n, c) float64, optional

    Returns
    -------
    means : (g, ...) float64
    residuals : (n, ...) float64

    Examples
    --------
    >>> adjusted_means(np.array([1.0, 3.0, 4.0]), np.array([0, 0, 1]))
    (array([2., 4.]), array([-1.,  1.,  0.]))
    """
    flat = values.reshape(len(values), -1)
    groups = _indicator(labels)
    design = groups if covariates is None else np.concatenate([groups, covariates - covariates.mean(axis=0)], axis=1)
    coefficients = np.linalg.lstsq(design, flat, rcond=None)[0]
    means = coefficients[: groups.shape[1]].reshape(-1, *values.shape[1:])
    return np.asarray(means), np.asarray((flat - design @ coefficients).reshape(values.shape))


def centroid_size(points: Floats) -> Floats:
    """Return the root mean square distance of the points of each shape from their centroid, (n,) [mm].

    Per point, so that it does not depend on how many there are.

    Examples
    --------
    >>> centroid_size(np.array([[[-2.0, 0], [2.0, 0]]]))
    array([2.])
    """
    centred = points - points.mean(axis=1, keepdims=True)
    return np.sqrt((centred**2).sum(axis=2).mean(axis=1))


def allometry(points: Floats, labels: Ints, size: Floats) -> float:
    """Return the share of the variation inside of the groups that goes with the logarithm of the size (Klingenberg 2016).

    Parameters
    ----------
    points : (n, n_P, d) float64
    labels : (n,) int64
    size : (n,) float64
        Positive.
    """
    _, inside = adjusted_means(points, labels)
    _, left = adjusted_means(points, labels, np.log(size)[:, None])
    return float(1.0 - (left**2).sum() / (inside**2).sum())


def _indicator(labels: Ints) -> Floats:
    return (labels[:, None] == np.arange(labels.max() + 1)).astype(np.float64)


def _basis(columns: Floats, scale: float | None = None) -> Floats:
    """Return orthonormal columns that span ``columns``, without directions that are rounding noise against ``scale``."""
    u, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, singular > 1e-8 * (scale if scale is not None else max(float(singular[0]), 1e-300))])
