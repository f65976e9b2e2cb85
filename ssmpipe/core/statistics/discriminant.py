"""The direction that tells groups apart, as a walk of shapes, and how well it sorts subjects that it has not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.statistics.covariates import adjusted_means


def shrunk_covariance(residuals: Floats) -> tuple[Floats, float]:
    """Return the covariance of centred rows drawn towards a multiple of the identity (Ledoit and Wolf 2004), and how far.

    Parameters
    ----------
    residuals : (n, k) float64

    Returns
    -------
    covariance : (k, k) float64
    shrinkage : float
        In [0, 1].

    Examples
    --------
    >>> round(shrunk_covariance(np.random.default_rng(0).normal(size=(20, 5)))[1], 2) > 0.3
    True
    """
    n, k = residuals.shape
    sample = residuals.T @ residuals / n
    target = np.trace(sample) / k * np.eye(k)
    apart = float(((sample - target) ** 2).sum())
    squared = (residuals**2).sum(axis=1)
    noise = float(((squared**2).sum() / n - (sample**2).sum()) / n)
    shrinkage = min(max(noise, 0.0) / apart, 1.0) if apart > 0 else 1.0
    return shrinkage * target + (1 - shrinkage) * sample, shrinkage


@dataclass(frozen=True, eq=False)
class Discriminant:
    """Linear discriminant of two groups.

    Parameters
    ----------
    scores : (n,) float64
        Of every shape; 0 half way between the groups, in standard deviations inside of the groups, positive towards the second.
    step : (n_P, d) float64
        How the shape changes on average with one unit of the score [mm]: what a walk along the discriminant shows (Haufe et
        al. 2014; the weights themselves would show noise that they cancel).
    centre : (n_P, d) float64
        Half way between the means.
    shrinkage : float
    """

    scores: Floats
    step: Floats
    centre: Floats
    shrinkage: float


def discriminant(
    points: Floats, mode_values: Floats, labels: Ints, degrees_of_error: int, covariates: Floats | None = None
) -> Discriminant:
    """Return Fisher's discriminant of two groups in the space of the kept modes, with a shrunk covariance.

    Parameters
    ----------
    points : (n, n_P, d) float64
    mode_values : (n, k) float64
        Components along the kept modes [mm].
    labels : (n,) int64
        0 or 1.
    degrees_of_error : int
    covariates : (n, c) float64, optional
    """
    means, residuals = adjusted_means(mode_values, labels, covariates)
    covariance, shrinkage = shrunk_covariance(residuals)
    weights = np.linalg.solve(covariance, means[1] - means[0])
    inside = residuals @ weights
    spread = float(np.sqrt((inside**2).sum() / degrees_of_error)) or 1.0
    group_points, point_residuals = adjusted_means(points, labels, covariates)
    step = np.tensordot(inside, point_residuals, axes=1) / (degrees_of_error * spread)
    adjusted = residuals + means[labels]
    scores = (adjusted - means.mean(axis=0)) @ weights / spread
    return Discriminant(scores, step, group_points.mean(axis=0), shrinkage)


@dataclass(frozen=True, eq=False)
class Classification:
    """What became of shapes that were sorted without having been seen.

    Parameters
    ----------
    predicted : (n,) int64
    accuracy, low, high : float
        Share sorted rightly, every subject counting once, and its confidence interval (Clopper and Pearson 1934, subjects as trials).
    balanced : float
        Mean of the groups' shares; chance is one over their number.
    n_folds : int
    """

    predicted: Ints
    accuracy: float
    low: float
    high: float
    balanced: float
    n_folds: int


def cross_validate(
    components: Floats,
    labels: Ints,
    subjects: Ints,
    n_modes: int,
    rng: np.random.Generator,
    *,
    covariates: Floats | None = None,
    max_folds: int = 10,
    level: float = 0.95,
) -> Classification:
    """Sort every shape by a discriminant that was made without its subject.

    Modes, covariates, means and covariance all come from the other subjects only.

    Parameters
    ----------
    components : (n, k) float64
        Coordinates of the shapes along all modes [mm].
    labels, subjects : (n,) int64
    n_modes : int
        Modes to keep in every fold.
    rng : numpy.random.Generator
        Deals the subjects into folds.
    covariates : (n, c) float64, optional
        Their effect inside of the groups of the other subjects is removed.
    max_folds : int
    level : float
    """
    fold = _folds(labels, subjects, max_folds, rng)
    predicted = np.zeros(len(labels), dtype=np.int64)
    n_groups = int(labels.max()) + 1
    for k in range(int(fold.max()) + 1):
        train, test = fold != k, fold == k
        if len(np.unique(labels[train])) < n_groups:
            predicted[test] = np.bincount(labels[train], minlength=n_groups).argmax()
            continue
        values = components
        if covariates is not None:
            values = components - covariates @ _slopes(components[train], labels[train], covariates[train])
        mean, modes, _, _ = principal_components(values[train][:, :, None])
        along = np.einsum("nk,mk->nm", values - mean[:, 0], modes[:n_modes, :, 0])
        means, residuals = adjusted_means(along[train], labels[train])
        weights = np.linalg.solve(shrunk_covariance(residuals)[0], means.T)
        offset = 0.5 * np.einsum("gm,mg->g", means, weights)
        predicted[test] = (along[test] @ weights - offset).argmax(axis=1)
    right = predicted == labels
    _, subject = np.unique(subjects, return_inverse=True)
    share = np.bincount(subject, right) / np.bincount(subject)
    successes, n_subjects = float(share.sum()), len(share)
    tail = (1 - level) / 2
    low = stats.beta.ppf(tail, successes, n_subjects - successes + 1) if successes > 0 else 0.0
    high = stats.beta.ppf(1 - tail, successes + 1, n_subjects - successes) if successes < n_subjects else 1.0
    balanced = float(np.mean([right[labels == g].mean() for g in range(n_groups)]))
    return Classification(predicted, float(share.mean()), float(low), float(high), balanced, int(fold.max()) + 1)


def _slopes(values: Floats, labels: Ints, covariates: Floats) -> Floats:
    """Return the effect of each covariate inside of the groups, (c, k)."""
    inside = adjusted_means(covariates, labels)[1]
    return np.asarray(np.linalg.lstsq(inside, adjusted_means(values, labels)[1], rcond=None)[0])


def _folds(labels: Ints, subjects: Ints, max_folds: int, rng: np.random.Generator) -> Ints:
    """Return the fold of every row: subjects whole, dealt out group by group so that folds are alike."""
    numbers, first, subject = np.unique(subjects, return_index=True, return_inverse=True)
    n_folds = min(max_folds, len(numbers))
    # groups in the order of their rows, not of their numbers: the same folds when the groups are swapped
    place = -np.unique(labels, return_index=True)[1][labels[first]]
    order = np.lexsort((rng.random(len(numbers)), place))
    of_subject = np.empty(len(numbers), dtype=np.int64)
    of_subject[order] = np.arange(len(numbers)) % n_folds
    return of_subject[subject.ravel()]
