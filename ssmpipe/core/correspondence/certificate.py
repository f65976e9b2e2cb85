"""Proof that a reparameterization is a diffeomorphism: a lower bound of ``det dD/du`` over the whole domain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.direction import Direction
from ssmpipe.core.correspondence.jacobian import Jacobian
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.window import Bounds

_REFINEMENTS = 4
Verdict = Literal["proved", "refuted", "undecided"]


@dataclass(frozen=True)
class Certificate:
    """Verdict on one shape.

    Parameters
    ----------
    lower_bound : float
        Proved lower bound of ``det dD/du`` on the unit square, rounding included.
    upper_bound_of_minimum : float
        The smallest value seen at a point; the true minimum lies between both.
    verdict : {"proved", "refuted", "undecided"}
        ``proved``: the bound is positive. ``refuted``: a point with a non-positive value was found.
    n_subdivisions : int
        Bisection levels of the Bernstein patches that were needed.
    """

    lower_bound: float
    upper_bound_of_minimum: float
    verdict: Verdict
    n_subdivisions: int


def certify(coefficients: Floats, reparameterization: Reparameterization, *, max_subdivisions: int = 12) -> Certificate:
    """Bound ``det dD/du`` of one shape from below by Bernstein coefficients, bisecting until proved or refuted.

    Parameters
    ----------
    coefficients : (*n_coefficients, d_par) float64
        Of ``D``.
    reparameterization : Reparameterization
    max_subdivisions : int, default=12

    Returns
    -------
    Certificate

    Notes
    -----
    A polynomial lies in the convex hull of its Bernstein coefficients, and the corner coefficients are values
    (Farouki 2012, sec. 4). Where edges are open, :func:`injective_edges` must hold as well, else the verdict is
    ``undecided``. Rounding is covered by subtracting an error bound of ``1e-13`` times the largest coefficient
    product per level, far above the accumulated unit round-off of the few hundred operations behind a coefficient.

    Examples
    --------
    >>> D = Reparameterization((6, 6), (3, 3))
    >>> certify(D.identity(), D).verdict
    'proved'
    """
    found = _bound(coefficients, reparameterization, max_subdivisions)
    if found.verdict == "proved" and not injective_edges(coefficients, reparameterization):
        return replace(found, verdict="undecided")
    return found


def injective_edges(coefficients: Floats, reparameterization: Reparameterization) -> bool:
    """Prove that a map with open edges and a positive Jacobian is one-to-one and stays in the domain; True without open edges.

    A local diffeomorphism that is free to move its edges might still overlap itself. On a rectangle it does not where the diagonal of
    its derivative is positive as well (Gale and Nikaido 1965, theorem 4). On an annulus it does not where its two rims are graphs over
    the angle that do not meet: every place has as many origins as those next to a rim, one.

    Parameters
    ----------
    coefficients : (*n_coefficients, d_par) float64
    reparameterization : Reparameterization

    Returns
    -------
    bool
        False where it could not be proved, by coefficients of the derivatives on up to eight times as many spans.

    Examples
    --------
    >>> from ssmpipe.core.correspondence.window import Window
    >>> D = Reparameterization((6, 6), (3, 3), window=Window((0.1, 0.1), (0.9, 0.9)))
    >>> injective_edges(D.identity(), D)
    True
    >>> turned = 0.5 + (D.identity() - 0.5) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    >>> injective_edges(turned, D)
    False
    """
    window = reparameterization.window
    if not window.open_edges:
        return True
    if Bounds(reparameterization.n_coefficients, window).slack(coefficients[None]).min() <= 0:
        return False
    if not reparameterization.periodic[0]:
        return all(
            _increasing(coefficients, reparameterization, axis) for axis in range(reparameterization.n_directions)
        )
    bottom, top = coefficients[:, 0, 1].max(), coefficients[:, -1, 1].min()
    return bool(bottom < top) and all(
        _increasing(np.take(coefficients, [end], axis=1), reparameterization, 0) for _, end in window.open_edges
    )


def _increasing(coefficients: Floats, reparameterization: Reparameterization, axis: int) -> bool:
    """Prove that component ``axis`` increases in direction ``axis``; other directions of the coefficients may be a part."""
    direction = reparameterization.directions[axis]
    extent = float(reparameterization.window.extent[axis])
    away = np.moveaxis(coefficients[..., axis], axis, 0)
    shape = (-1,) + (1,) * (away.ndim - 1)
    away = away - (reparameterization.window.low[axis] + extent * direction.identity).reshape(shape)
    for k in range(_REFINEMENTS):
        if k > 0:
            spans = 2 * direction.n_spans
            count = spans if direction.periodic else spans + direction.degree
            finer = Direction(count, direction.degree, direction.periodic)
            away = np.tensordot(direction.refinement(finer), away, axes=(1, 0))
            direction = finer
        values = away + (extent * direction.identity).reshape(shape)
        if direction.periodic:
            values = np.concatenate([values, values[:1] + extent])
        if np.diff(values, axis=0).min() > 1e-13:
            return True
    return False


def _bound(coefficients: Floats, reparameterization: Reparameterization, max_subdivisions: int) -> Certificate:
    """Bound the determinant."""
    jacobian = Jacobian(reparameterization)
    patches = jacobian.patches(jacobian.coefficients(coefficients[None]))[0]
    slope = max(jacobian.n_spans) * reparameterization.degree
    rounding = 1e-13 * max(1.0, float(np.abs(patches).max()), slope**2 * float(np.abs(coefficients).max()) ** 2)
    left, right = _bisection(jacobian.degree)
    inner = tuple(range(1, patches.ndim))
    lower = np.inf
    seen = np.inf
    for level in range(max_subdivisions + 1):
        corners = patches[:, [0, -1]] if patches.ndim == 2 else patches[:, [0, 0, -1, -1], [0, -1, 0, -1]]
        seen = min(seen, float(corners.min()))
        smallest = patches.min(axis=inner)
        if seen <= 0:
            return Certificate(float(min(smallest.min(), lower)) - rounding, seen, "refuted", level)
        positive = smallest > rounding
        if positive.any():
            lower = min(lower, float(smallest[positive].min()))
        if positive.all():
            return Certificate(lower - rounding, seen, "proved", level)
        patches = patches[~positive]
        if level < max_subdivisions:
            if patches.ndim == 2:
                patches = np.concatenate([patches @ left.T, patches @ right.T])
            else:
                halves = np.concatenate([left @ patches, right @ patches])
                patches = np.concatenate([halves @ left.T, halves @ right.T])
    return Certificate(float(patches.min()) - rounding, seen, "undecided", max_subdivisions)


def _bisection(degree: int) -> tuple[Floats, Floats]:
    """Return the de Casteljau matrices of the left and right half."""
    k = np.arange(degree + 1)
    left = np.where(k[None, :] <= k[:, None], comb(k[:, None], k[None, :]) * 0.5 ** k[:, None], 0.0)
    return left, left[::-1, ::-1].copy()
