"""The model given what was observed of one shape: Gaussian process regression with the modes and a smooth remainder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.model.remainder import Remainder
from ssmpipe.core.model.shape_model import ShapeModel


@dataclass(frozen=True, eq=False)
class Observations:
    """Places of which one coordinate is known: ``direction . x(point) = value + noise``.

    Parameters
    ----------
    points : (n,) int64
        Which point of the model; it may occur several times.
    directions : (n, d) float64
        Unit vectors.
    values : (n,) float64
        [mm]
    """

    points: Ints
    directions: Floats
    values: Floats

    @classmethod
    def of_places(cls, points: Ints, places: Floats) -> Observations:
        """Return observations of all coordinates of some points.

        Examples
        --------
        >>> Observations.of_places(np.array([4]), np.array([[1.0, 2.0]])).values
        array([1., 2.])
        """
        d = places.shape[1]
        return cls(np.repeat(points, d), np.tile(np.eye(d), (len(points), 1)), places.ravel())


NOWHERE: Ints = np.empty(0, dtype=np.int64)
"""No point: for ``deviation_at``."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """The model given observations.

    Parameters
    ----------
    scores : (n_modes,)
        Coefficients, posterior mean [standard deviations of the model].
    covariance : (n_modes, n_modes)
        Theirs.
    points : (n_P, d)
        Expected shape, remainder included, rigid motion left out [mm].
    motion : (6,) or (3,)
        Rotation vector about the centroid of the mean [rad], then translation [mm]; zeros when not asked for.
    deviation : (n_P, d) or (n, d)
        Standard deviation of every coordinate of the points asked for, motion and noise included [mm].
    """

    scores: Floats
    covariance: Floats
    points: Floats
    motion: Floats
    deviation: Floats


def rigid_fields(mean: Floats) -> Floats:
    """Return the displacements of small rotations about the centroid and of translations, (6, n_P, 3), or (3, n_P, 2) in the plane.

    Examples
    --------
    >>> rigid_fields(np.array([[1.0, 0], [-1, 0]]))[0]
    array([[-0.,  1.],
           [-0., -1.]])
    """
    n_points, d = mean.shape
    arm = mean - mean.mean(axis=0)
    if d == 2:
        turns = np.stack([-arm[:, 1], arm[:, 0]], axis=-1)[None]
    else:
        turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)])
    shifts = np.repeat(np.eye(d)[:, None], n_points, axis=1)
    return np.concatenate([turns, shifts])


def posterior(
    model: ShapeModel,
    remainder: Remainder,
    seen: Observations,
    *,
    noise: float | Floats | None = None,
    motion_deviation: tuple[float, float] | None = None,
    deviation_at: Ints | None = None,
) -> Posterior:
    """Return the model given observations (Albrecht et al. 2013; Luethi et al. 2018, sec. 4).

    ``x = mean + sum_m a_m sqrt(lambda_m) v_m + w + e``: coefficients ``a`` of variance one, a smooth remainder ``w`` and noise ``e``
    as fitted to leave-one-out residuals, so that the uncertainty holds what a model of few shapes does not know.

    Parameters
    ----------
    model : ShapeModel
    remainder : Remainder
    seen : Observations
    noise : float or (n,) float64, optional
        Variance of the observations [mm^2]; that of the remainder by default.
    motion_deviation : (float, float), optional
        Prior standard deviation of a rigid motion that is estimated with the shape: rotation [rad], translation [mm].
    deviation_at : (n,) int64, optional
        Points whose uncertainty is computed, which takes most of the time; all by default.

    Returns
    -------
    Posterior

    Notes
    -----
    Cost: ``n^3 / 3`` for ``n`` observations, and ``n^2 d n_P`` for the uncertainty.

    Examples
    --------
    Two points that move alike, with a standard deviation of 2 mm; of one of them it is known that it moved by 2 mm.

    >>> mode = np.full((1, 2, 2), 0.5)
    >>> mean, no_faces = np.array([[0.0, 0], [9, 0]]), np.empty((0, 3), dtype=np.int64)
    >>> model = ShapeModel(("a",), mean, mode, np.array([16.0]), np.zeros((1, 1)), (2,), no_faces, "curve-open")
    >>> seen = Observations.of_places(np.array([0]), np.array([[2.0, 2.0]]))
    >>> found = posterior(model, Remainder(1e-6, 1.0, 1e-6), seen)
    >>> found.scores.round(3), found.points.round(3)[1], bool(found.deviation.max() < 0.01)
    (array([1.]), array([11.,  2.]), True)
    """
    mean, d = model.mean, model.mean.shape[1]
    n_modes = len(model.variances)
    basis = np.sqrt(model.variances)[:, None, None] * model.modes
    if motion_deviation is not None:
        rigid = rigid_fields(mean)
        widths = np.repeat(motion_deviation, [len(rigid) - d, d])
        basis = np.concatenate([basis, widths[:, None, None] * rigid])
    rows = np.einsum("mjc,jc->jm", basis[:, seen.points], seen.directions)
    offset = seen.values - np.einsum("jc,jc->j", mean[seen.points], seen.directions)
    covariance = remainder.kernel(mean[seen.points], mean[seen.points]) * (seen.directions @ seen.directions.T)
    own = np.maximum(remainder.noise if noise is None else noise, 1e-9 * remainder.variance)
    covariance[np.diag_indices(len(covariance))] += own
    factor = scipy.linalg.cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
    solved = scipy.linalg.cho_solve(factor, np.column_stack([rows, offset]), check_finite=False)
    precision = np.eye(len(basis)) + rows.T @ solved[:, :-1]
    spread_ = np.linalg.inv(precision)
    coefficients = spread_ @ (rows.T @ solved[:, -1])
    left = solved[:, -1] - solved[:, :-1] @ coefficients
    cross = remainder.kernel(mean, mean[seen.points])
    smooth = cross @ (seen.directions * left[:, None])
    points = mean + np.einsum("m,mld->ld", coefficients[:n_modes], basis[:n_modes]) + smooth
    at = np.arange(len(mean)) if deviation_at is None else deviation_at
    variance = np.empty((len(at), d))
    if len(at):
        triangle = np.tril(factor[0])
        white_rows = scipy.linalg.solve_triangular(triangle, rows, lower=True, check_finite=False)
    for c in range(d if len(at) else 0):
        white = scipy.linalg.solve_triangular(
            triangle, (cross[at] * seen.directions[:, c]).T, lower=True, check_finite=False
        )
        not_explained = basis[:, at, c].T - white.T @ white_rows
        variance[:, c] = remainder.variance - (white**2).sum(axis=0)
        variance[:, c] += np.einsum("lm,mk,lk->l", not_explained, spread_, not_explained)
    deviation = np.sqrt(np.maximum(variance, 0.0) + remainder.noise)
    motion = np.zeros(3 if d == 2 else 6)
    if motion_deviation is not None:
        motion = widths * coefficients[n_modes:]
    return Posterior(coefficients[:n_modes], spread_[:n_modes, :n_modes], points, motion, deviation)
