"""What a model of few shapes does not reach: leave-one-out residuals, and a Gaussian process fitted to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.spatial.distance import cdist

from ssmpipe.core.arrays import Floats, Ints

_FIT_POINTS = 200
_LENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0)
_LONG = (0.2, 0.5, 0.8)
_SHARES = (1e-3, 1e-2, 5e-2, 0.2)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Every shape seen by the model of the others.

    Parameters
    ----------
    residuals : (n_S, n_P, d)
        From the nearest instance of all modes of the others to the shape [mm].
    mahalanobis : (n_S,)
        Distance of that instance from the mean of the others [standard deviations].
    """

    residuals: Floats
    mahalanobis: Floats


def leave_one_out(points: Floats) -> LeaveOneOut:
    """Return residuals and Mahalanobis distances of every shape in the model of all others, all modes kept.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        At least three shapes.

    Notes
    -----
    In closed form. With the pseudoinverse ``Q`` of the Gram matrix of the centred shapes, row ``i`` of ``Q`` over ``Q_ii`` gives the
    combination of shapes that is orthogonal to all differences of the others; the weights of the others in it give the distance.

    Examples
    --------
    >>> line = np.array([0.0, 1, 2, 5])[:, None, None] * np.ones((1, 4, 3))
    >>> bool(np.allclose(leave_one_out(line).residuals, 0, atol=1e-9))
    True
    """
    n = len(points)
    flat = (points - points.mean(axis=0)).reshape(n, -1)
    gram = flat @ flat.T
    values, vectors = np.linalg.eigh(gram)
    keep = values > 1e-10 * max(float(values[-1]), 0.0)
    if int(keep.sum()) < n - 1:  # shapes that depend on each other: nothing is orthogonal to the rest
        return _one_by_one(flat, points.shape)
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    combination = inverse / np.diagonal(inverse)[:, None]
    residuals = (combination @ flat).reshape(points.shape)
    others = ~np.eye(n, dtype=bool)
    weights = np.where(others, -combination - 1.0 / (n - 1), 0.0)
    return LeaveOneOut(residuals, np.sqrt((n - 2) * (weights**2).sum(axis=1)))


def _one_by_one(flat: Floats, shape: tuple[int, ...]) -> LeaveOneOut:
    residuals, distances = [], []
    for i in range(len(flat)):
        rest = np.delete(flat, i, axis=0)
        mean = rest.mean(axis=0)
        _, s, vt = np.linalg.svd(rest - mean, full_matrices=False)
        keep = s > 1e-10 * max(float(s[0]), 1e-300)
        along = vt[keep] @ (flat[i] - mean)
        residuals.append(flat[i] - mean - along @ vt[keep])
        distances.append(np.sqrt((len(rest) - 1) * ((along / s[keep]) ** 2).sum()))
    return LeaveOneOut(np.array(residuals).reshape(shape), np.array(distances))


@dataclass(frozen=True)
class Remainder:
    """Zero-mean Gaussian process on the mean shape, the same and independent in every coordinate: a short, a long and a white part.

    Parameters
    ----------
    variance : float
        Of the smooth parts together, per coordinate [mm^2].
    length : float
        Over which the short part changes: of a Matern 3/2 kernel [mm].
    noise : float
        Variance of what varies from point to point, per coordinate [mm^2].
    long_length : float
        Of the long part, such as errors of pose and size [mm].
    long_share : float
        Share of the long part in ``variance``.
    """

    variance: float
    length: float
    noise: float
    long_length: float = 1.0
    long_share: float = 0.0

    def kernel(self, a: Floats, b: Floats) -> Floats:
        """Return the covariance of the smooth parts between (n, d) and (m, d) places on the mean [mm^2].

        Examples
        --------
        >>> Remainder(4.0, 1.0, 0.1).kernel(np.zeros((1, 3)), np.zeros((1, 3)))
        array([[4.]])
        """
        distance = cdist(a, b)
        values = (1.0 - self.long_share) * _matern(distance, self.length)
        if self.long_share > 0:
            values += self.long_share * _matern(distance, self.long_length)
        return np.asarray(self.variance * values)


def _matern(distance: Floats, length: float) -> Floats:
    scaled = np.sqrt(3.0) / length * distance
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def fit_remainder(residuals: Floats, mean: Floats) -> Remainder:
    """Fit the process to leave-one-out residuals by maximum likelihood (Rasmussen and Williams 2006, ch. 5).

    Lengths and shares are searched on a fixed grid, the variance follows in closed form; on a fixed subset of the points.

    Parameters
    ----------
    residuals : (n_S, n_P, d) float64
    mean : (n_P, d) float64

    Returns
    -------
    Remainder
        Its total variance per coordinate is the mean square of all residuals.
    """
    total = float((residuals**2).mean())
    size = float(np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if not total > 1e-12 * size**2:
        return Remainder(1e-12 * size**2, 0.25 * size, 1e-12 * size**2)
    chosen = farthest_first(mean, _FIT_POINTS)
    columns = np.moveaxis(residuals[:, chosen], 1, 0).reshape(len(chosen), -1)
    distance = cdist(mean[chosen], mean[chosen])
    parts = [_matern(distance, length * size) for length in _LENGTHS]
    best = (np.inf, 0, 0, 0.0, 0.0)
    for i, j, long_share in _mixtures():
        values, vectors = scipy.linalg.eigh((1.0 - long_share) * parts[i] + long_share * parts[j])
        energy = ((vectors.T @ columns) ** 2).sum(axis=1)
        for share in _SHARES:
            mixed = (1.0 - share) * np.maximum(values, 0.0) + share
            scale = float((energy / mixed).mean() / columns.shape[1])
            cost = float(np.log(mixed).sum() + len(mixed) * np.log(scale))
            best = min(best, (cost, i, j, long_share, share))
    _, i, j, long_share, share = best
    return Remainder((1.0 - share) * total, _LENGTHS[i] * size, share * total, _LENGTHS[j] * size, long_share)


def _mixtures() -> list[tuple[int, int, float]]:
    """Return (short, long, share of the long one): indices of lengths; one length alone first."""
    alone = [(i, i, 0.0) for i in range(len(_LENGTHS))]
    return alone + [(i, j, s) for i in range(len(_LENGTHS)) for j in range(i + 2, len(_LENGTHS)) for s in _LONG]


def farthest_first(points: Floats, n: int) -> Ints:
    """Return the numbers of at most ``n`` of (n_P, d) points that lie far from each other, in rising order.

    Always the point farthest from those chosen so far; the first one is that nearest to the centroid.

    Examples
    --------
    >>> farthest_first(np.array([[0.0], [1], [2], [3], [8]]), 3)
    array([0, 3, 4])
    """
    if len(points) <= n:
        return np.arange(len(points))
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    nearest = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    for _ in range(n - 1):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.sort(np.array(chosen, dtype=np.int64))
