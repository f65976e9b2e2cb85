"""Covariance of corresponded points: weights, Gram matrix, and the adjoint of a spectral function of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from ssmpipe.core.arrays import Floats
from ssmpipe.core.blocks import map_blocks
from ssmpipe.core.correspondence.passes import centre_and_scale, contract
from ssmpipe.core.correspondence.spectral import SpectralFunction
from ssmpipe.core.spline.evaluate import Evaluator

CHOLESKY_FROM = 200
"""Number of shapes from which the log-determinant is computed without eigenvalues."""
_MANY = 4


@dataclass(frozen=True, eq=False)
class SlopeProduct:
    """A symmetric matrix ready to be multiplied: ``matrix``, or ``last I + matrix diag(excess) matrix^T``."""

    matrix: Floats
    excess: Floats | None = None
    last: float = 0.0

    def __call__(self, columns: Floats) -> Floats:
        """Return the product with (n_S, n) columns."""
        if self.excess is None:
            return np.asarray(self.matrix @ columns)
        return np.asarray(self.last * columns + self.matrix @ (self.excess * (self.matrix.T @ columns)))


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The (n_S, n_S) Gram matrix and, computed when first asked for, its eigendecomposition without the null direction."""

    gram: Floats

    @cached_property
    def _pairs(self) -> tuple[Floats, Floats]:
        values, vectors = np.linalg.eigh(self.gram)
        return values[:0:-1].copy(), vectors[:, :0:-1].copy()

    @property
    def eigenvalues(self) -> Floats:
        """``n_S - 1`` eigenvalues [mm^2], decreasing."""
        return self._pairs[0]

    @property
    def vectors(self) -> Floats:
        """The (n_S, n_S - 1) eigenvectors, columns."""
        return self._pairs[1]

    def value(self, function: SpectralFunction) -> float:
        """Return ``sum phi(lambda_m)``; by a Cholesky factor where that is faster and enough."""
        if self._by_cholesky(function):
            return float(2.0 * np.log(np.diagonal(self._factor(function.shift)[0])).sum() - np.log(function.shift))
        return function.value(self.eigenvalues)

    def slope(self, function: SpectralFunction) -> Floats:
        """Return ``V diag(phi') V^T``, the derivative in the Gram matrix; a constant on the null direction does no harm."""
        if self._by_cholesky(function):
            n = len(self.gram)
            inverse = scipy.linalg.cho_solve(self._factor(function.shift), np.eye(n), check_finite=False)
            return np.asarray(0.5 * (inverse + inverse.T) - 1.0 / (n * function.shift))
        return np.asarray((self.vectors * function.slope(self.eigenvalues)) @ self.vectors.T)

    def slope_product(self, function: SpectralFunction) -> SlopeProduct:
        """Return the product of :meth:`slope` with (n_S, n) columns that sum to zero.

        Modes with the same ``phi'`` as the last one, all below the threshold of the description length, need no eigenvectors;
        where they are many the product is the cheaper for it.
        """
        if not self._by_cholesky(function):
            slopes = function.slope(self.eigenvalues)
            other = slopes != slopes[-1]
            if _MANY * np.count_nonzero(other) <= len(slopes):
                vectors, excess = self.vectors[:, other], (slopes[other] - slopes[-1])[:, None]
                return SlopeProduct(vectors, excess, float(slopes[-1]))
        return SlopeProduct(self.slope(function))

    def _by_cholesky(self, function: SpectralFunction) -> bool:
        return function.shift > 0 and len(self.gram) >= CHOLESKY_FROM

    def _factor(self, shift: float) -> tuple[Floats, bool]:
        shifted = self.gram + shift * np.eye(len(self.gram))
        return scipy.linalg.cho_factor(shifted, lower=True, check_finite=False)


def landmarks_per_block(n_shapes: int) -> int:
    """Return how many landmarks of all shapes are worked on at once: few enough for the cache, many enough for numpy."""
    return max(256, 45_000 // n_shapes)


def centred_spectrum(
    points: Floats, weights: Floats, *, threads: int = 1, evaluator: Evaluator = "numpy", out: Floats | None = None
) -> tuple[Floats, Spectrum]:
    """Return points minus their mean over the shapes, and the nonzero spectrum of ``Xc W Xc^T / (n_S - 1)`` (Li 2015, [1.20-1.22]).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    weights : (n_P,) float64
        Non-negative, sum 1.
    threads : int, default=1
        They share fixed blocks of landmarks, summed in order: any number gives the same bits.
    evaluator : {"numpy", "numba"}, default="numpy"
        Both give the same bits.
    out : (n_S, n_P, d), optional
        Memory of the centred points.
    """
    n_shapes = len(points)
    centred = np.empty(points.shape) if out is None else out
    root = np.sqrt(weights / (n_shapes - 1))

    def one(block: slice) -> Floats:
        flat = centre_and_scale(points, root, centred, block, evaluator)
        return np.asarray(flat @ flat.T)

    gram = np.zeros((n_shapes, n_shapes))
    for part in map_blocks(one, points.shape[1], landmarks_per_block(n_shapes), threads):
        gram += part
    return centred, Spectrum(gram)


def spectral_adjoint(centred: Floats, weights: Floats, slope_product: Callable[[Floats], Floats]) -> Floats:
    """Return the derivative of ``sum phi(lambda_m)`` in the landmarks of all shapes, at fixed weights, (n_S, n_P, d).

    It is the closed solution ``mu_m = phi'(lambda_m) v_m`` of the adjoint system [2.20].

    Parameters
    ----------
    centred, weights
        As in :func:`centred_spectrum`.
    slope_product : callable
        :meth:`Spectrum.slope_product`, or some rows of it.
    """
    n_shapes = len(centred)
    product = slope_product(centred.reshape(n_shapes, -1)).reshape(-1, *centred.shape[1:])
    product *= (2.0 / (n_shapes - 1) * weights)[:, None]
    return np.asarray(product)


def parameter_adjoint(
    centred: Floats,
    weights: Floats,
    slope_product: Callable[[Floats], Floats],
    tangents: tuple[Floats, ...],
    out: Floats,
    *,
    threads: int = 1,
    evaluator: Evaluator = "numpy",
) -> None:
    """Write the derivative of ``sum phi(lambda_m)`` in the parameters of all landmarks: :func:`spectral_adjoint` along the tangents.

    Parameters
    ----------
    centred, weights, slope_product
        As in :func:`spectral_adjoint`.
    tangents : d_par arrays of (n_S, n_P, d)
    out : (n_S, d_par, n_P)
        Is overwritten.
    threads, evaluator
        As in :func:`centred_spectrum`.
    """
    n_shapes, n_p, d = centred.shape
    columns, factor = centred.reshape(n_shapes, -1), 2.0 / (n_shapes - 1) * weights

    def one(block: slice) -> None:
        forces = slope_product(columns[:, d * block.start : d * block.stop])
        contract(forces, factor, tangents, out, block, evaluator)

    map_blocks(one, n_p, landmarks_per_block(n_shapes), threads)


def weight_adjoint(centred: Floats, d_gram: Floats) -> Floats:
    """Return the derivative of ``sum phi(lambda_m)`` in the weights, (n_P,)."""
    n_shapes = len(centred)
    product = (d_gram @ centred.reshape(n_shapes, -1)).reshape(centred.shape)
    return np.asarray(np.einsum("ild,ild->l", product, centred) / (n_shapes - 1))
