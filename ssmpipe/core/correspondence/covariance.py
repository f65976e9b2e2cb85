"""Covariance of corresponded points: weights, Gram matrix, and the adjoint of a spectral function of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigendecomposition of the (n_S, n_S) Gram matrix, without its null direction, eigenvalues decreasing."""

    eigenvalues: Floats
    vectors: Floats


def spectrum(centred: Floats, weights: Floats) -> Spectrum:
    """Return the nonzero spectrum of ``Xc W Xc^T / (n_S - 1)`` (Li 2015, [1.20-1.22]).

    Parameters
    ----------
    centred : (n_S, n_P, d) float64
        Points minus their mean over the shapes.
    weights : (n_P,) float64
        Non-negative, sum 1.

    Returns
    -------
    Spectrum
        ``n_S - 1`` eigenvalues [mm^2] and the columns of ``vectors`` (n_S, n_S - 1).
    """
    n_shapes = len(centred)
    flat = (centred * np.sqrt(weights)[:, None]).reshape(n_shapes, -1)
    values, vectors = np.linalg.eigh(flat @ flat.T / (n_shapes - 1))
    return Spectrum(values[:0:-1].copy(), vectors[:, :0:-1].copy())


def spectral_adjoint(
    centred: Floats, weights: Floats, spec: Spectrum, slope: Callable[[Floats], Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return the derivative of ``sum phi(lambda_m)`` in the points and in the weights.

    Parameters
    ----------
    centred, weights
        As in :func:`spectrum`.
    spec : Spectrum
    slope : callable
        ``phi'`` on an array of eigenvalues.

    Returns
    -------
    d_points : (n_S, n_P, d)
        At fixed weights. It is the closed solution ``mu_m = phi'(lambda_m) v_m`` of the adjoint system [2.20].
    d_weights : (n_P,)
    d_gram : (n_S, n_S)
        ``V diag(phi') V^T``; its diagonal weighs the Gauss-Newton blocks.
    """
    n_shapes = len(centred)
    d_gram = (spec.vectors * slope(spec.eigenvalues)) @ spec.vectors.T
    product = (d_gram @ centred.reshape(n_shapes, -1)).reshape(centred.shape) / (n_shapes - 1)
    d_weights = np.einsum("ild,ild->l", product, centred)
    return 2.0 * product * weights[:, None], d_weights, d_gram
