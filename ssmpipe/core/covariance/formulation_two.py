"""Covariance weighed by arc length or area of the mean shape (formulation II), and its exact gradient."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.covariance.formulation_one import gauss_rule_for, weighted_covariance
from ssmpipe.core.covariance.quadrature import Rule, midpoints, tensor
from ssmpipe.core.covariance.sampling import sample
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import Spline

# -- weights -----------------------------------------------------------------------------------------------------------


def size_element(tangents: tuple[Floats, ...]) -> Floats:
    """Return the length element ``|M_u|`` [1.26] or area element ``|M_u x M_v|`` [1.27] of the mean shape.

    Parameters
    ----------
    tangents : (d_par arrays of) (n_P, d) float64
        Derivatives of the mean; d = 3 for surfaces.

    Returns
    -------
    (n_P,) float64

    Examples
    --------
    >>> size_element((np.array([[3.0, 4.0]]),))
    array([5.])
    """
    if len(tangents) == 1:
        return np.asarray(np.linalg.norm(tangents[0], axis=-1))
    return np.asarray(np.linalg.norm(np.cross(tangents[0], tangents[1]), axis=-1))


def size_weights(base: Floats, tangents: tuple[Floats, ...]) -> Floats:
    """Return the weights of formulation II: quadrature weight times size element of the mean, sum 1 (Li 2015, [1.25]).

    Parameters
    ----------
    base : (n_P,) float64
        Weights of the quadrature rule in the parameter domain.
    tangents : (d_par arrays of) (n_P, d) float64
        Derivatives of the mean shape.

    Raises
    ------
    GeometryError
        If the mean shape has no length or area.

    Examples
    --------
    >>> size_weights(np.array([0.5, 0.5]), (np.array([[1.0, 0.0], [0.0, 3.0]]),))
    array([0.25, 0.75])
    """
    share = base * size_element(tangents)
    total = float(share.sum())
    if not total > 0:
        raise GeometryError("the mean shape has no length or area, so it cannot weigh its points")
    return share / total


def size_weights_adjoint(base: Floats, tangents: tuple[Floats, ...], d_weights: Floats) -> tuple[Floats, ...]:
    """Return ``df/d(tangents)`` from ``df/d(weights)`` of :func:`size_weights`; zero where the element vanishes.

    Parameters
    ----------
    base, tangents
        As in :func:`size_weights`.
    d_weights : (n_P,) float64

    Returns
    -------
    (d_par arrays of) (n_P, d) float64
    """
    element = size_element(tangents)
    total = float((base * element).sum())
    d_element = base * (d_weights - float(d_weights @ (base * element)) / total) / total
    factor = np.divide(d_element, element, out=np.zeros_like(element), where=element > 0)[:, None]
    if len(tangents) == 1:
        return (tangents[0] * factor,)
    normal = np.cross(tangents[0], tangents[1]) * factor
    return np.cross(tangents[1], normal), np.cross(normal, tangents[0])


def chord_weights(mean: Floats) -> Floats:
    """Return the share of the polygon's length that each sampled point of an open mean curve stands for [3.15].

    Parameters
    ----------
    mean : (n_P, d) float64

    Returns
    -------
    (n_P,) float64
        Half of each adjacent chord, sum 1.

    Examples
    --------
    >>> chord_weights(np.array([[0.0, 0.0], [1.0, 0.0], [4.0, 0.0]]))
    array([0.125, 0.5  , 0.375])
    """
    half = 0.5 * np.linalg.norm(np.diff(mean, axis=0), axis=-1)
    share = np.pad(half, (0, 1)) + np.pad(half, (1, 0))
    return np.asarray(share / share.sum())


def quadrangle_weights(mean: Floats) -> Floats:
    """Return the share of area that each grid point of a mean surface stands for (after Li 2015, [3.16]).

    Every quadrangle is two triangles, and its area is shared by its four corners.

    Parameters
    ----------
    mean : (n_1, n_2, 3) float64

    Returns
    -------
    (n_1 * n_2,) float64
        Sum 1.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(2.0), np.arange(3.0), indexing="ij")
    >>> quadrangle_weights(np.stack([x, y, 0 * x], axis=-1)).reshape(2, 3)
    array([[0.125, 0.25 , 0.125],
           [0.125, 0.25 , 0.125]])
    """
    a, b, c, d = mean[:-1, :-1], mean[1:, :-1], mean[1:, 1:], mean[:-1, 1:]
    areas = 0.5 * (np.linalg.norm(np.cross(b - a, c - a), axis=-1) + np.linalg.norm(np.cross(c - a, d - a), axis=-1))
    share = sum(np.pad(areas, ((r, 1 - r), (s, 1 - s))) for r in (0, 1) for s in (0, 1))
    return np.asarray(share / np.sum(share)).ravel()


# -- covariance --------------------------------------------------------------------------------------------------------


def size_weighted_covariance(points: Floats, first: tuple[Floats, ...], base: Floats) -> Floats:
    """Return the (n_S, n_S) covariance of formulation II of sampled shapes (Li 2015, [1.25]).

    Parameters
    ----------
    points : (n_S, n_P, d) float64
    first : (d_par arrays of) (n_S, n_P, d) float64
        Derivatives of the shapes with respect to the parameters that ``base`` integrates over.
    base : (n_P,) float64
    """
    return weighted_covariance(points, size_weights(base, _mean(first)))


def size_weighted_covariance_adjoint(
    points: Floats, first: tuple[Floats, ...], base: Floats, d_covariance: Floats
) -> tuple[Floats, tuple[Floats, ...]]:
    """Return the exact gradient of a function of the covariance of formulation II.

    Parameters
    ----------
    points, first, base
        As in :func:`size_weighted_covariance`.
    d_covariance : (n_S, n_S) float64
        ``df/dC``.

    Returns
    -------
    d_points : (n_S, n_P, d) float64
        Through the mean-removed points, at fixed weights.
    d_first : (d_par arrays of) (n_S, n_P, d) float64
        Through the weights; every shape has an equal share in the mean.
    """
    n_shapes = len(points)
    mean_first = _mean(first)
    weights = size_weights(base, mean_first)
    centred = points - points.mean(axis=0)
    symmetric = (d_covariance + d_covariance.T) / (n_shapes - 1)
    product = (symmetric @ centred.reshape(n_shapes, -1)).reshape(centred.shape)
    d_centred = product * weights[:, None]
    d_weights = 0.5 * np.einsum("ild,ild->l", product, centred)
    d_mean = size_weights_adjoint(base, mean_first, d_weights)
    d_first = tuple(np.repeat(g[None] / n_shapes, n_shapes, axis=0) for g in d_mean)
    return d_centred - d_centred.mean(axis=0), d_first


def covariance_by_rule(splines: Sequence[Spline], rule: Rule, maps: Sequence[Spline] | None = None) -> Floats:
    """Return the covariance of formulation II by any quadrature rule, with analytic derivatives of the mean.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
    rule : Rule
    maps : sequence of splines, optional
        Reparameterizations ``D_i``, of dimension ``d_par`` (Li 2015, [3.32]).
    """
    jet = sample(splines, rule.parameters, maps)
    return size_weighted_covariance(jet.points, jet.first, rule.weights)


def covariance_midpoint(
    splines: Sequence[Spline], counts: Sequence[int], maps: Sequence[Spline] | None = None
) -> Floats:
    """Return the covariance of formulation II by the mid-point rule with ``counts`` points per direction [3.14, 3.16]."""
    return covariance_by_rule(splines, tensor(*(midpoints(n) for n in counts)), maps)


def covariance_gauss(
    splines: Sequence[Spline], maps: Sequence[Spline] | None = None, n_per_span: Sequence[int] | None = None
) -> Floats:
    """Return the covariance of formulation II by Gauss quadrature per span.

    Parameters
    ----------
    splines, maps
        As in :func:`covariance_by_rule`.
    n_per_span : sequence of int, optional
        20 per direction if absent. The size element is no polynomial, so no finite number is exact.
    """
    counts = n_per_span if n_per_span is not None else (20,) * len(splines[0].degrees)
    return covariance_by_rule(splines, gauss_rule_for(splines, maps, counts), maps)


def _mean(first: tuple[Floats, ...]) -> tuple[Floats, ...]:
    return tuple(np.asarray(f.mean(axis=0)) for f in first)
