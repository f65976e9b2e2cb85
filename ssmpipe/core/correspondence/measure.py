"""Where landmarks lie in the parameter domain and what each one weighs in the covariance."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.errors import GeometryError

Quadrature = Literal["grid", "midpoint", "gauss"]


def landmark_rule(
    reparameterization: Reparameterization, counts: tuple[int, ...], quadrature: Quadrature
) -> tuple[tuple[Floats, ...], Floats]:
    """Return tensor nodes and their weights.

    Parameters
    ----------
    reparameterization : Reparameterization
    counts : tuple of int
        Landmarks per direction. For ``gauss`` the next multiple of the number of spans of ``D`` is taken.
    quadrature : {"grid", "midpoint", "gauss"}
        ``grid``: evenly spaced, ends included, equal weights: the discrete formulation [1.5]. ``midpoint``: cell centres [3.12].
        ``gauss``: Gauss-Legendre points on every span of ``D`` [3.8].

    Returns
    -------
    nodes : tuple of (n,) arrays
    weights : (prod n,) float64
        Sum 1.
    """
    nodes, weights = [], []
    for direction, n in zip(reparameterization.directions, counts, strict=True):
        if quadrature == "grid":
            nodes.append(np.linspace(0.0, 1.0, n, endpoint=not direction.periodic))
            weights.append(np.full(n, 1.0 / n))
        elif quadrature == "midpoint":
            nodes.append((np.arange(n) + 0.5) / n)
            weights.append(np.full(n, 1.0 / n))
        elif quadrature == "gauss":
            u, w = direction.gauss_rule(-(-n // direction.n_spans))
            nodes.append(u)
            weights.append(w)
        else:
            raise GeometryError(f"there is no quadrature '{quadrature}'", "grid, midpoint or gauss")
    total = weights[0] if len(weights) == 1 else np.multiply.outer(weights[0], weights[1]).ravel()
    return tuple(nodes), total


def size_element(tangents: tuple[Floats, ...]) -> Floats:
    """Return the length or area element (n_P,) from the derivatives (n_P, d) in each direction.

    Examples
    --------
    >>> size_element((np.array([[3.0, 4.0]]),))
    array([5.])
    """
    if len(tangents) == 1:
        return np.asarray(np.linalg.norm(tangents[0], axis=-1))
    return np.asarray(np.linalg.norm(np.cross(tangents[0], tangents[1]), axis=-1))


def size_weights(base: Floats, tangents: tuple[Floats, ...]) -> Floats:
    """Return the weights of formulation II: quadrature weight times size element of the mean, sum 1 [1.25, 3.14-3.16]."""
    share = base * size_element(tangents)
    return share / share.sum()


def size_weights_adjoint(base: Floats, tangents: tuple[Floats, ...], d_weights: Floats) -> tuple[Floats, ...]:
    """Return ``df/d(tangents)`` from ``df/d(weights)`` of :func:`size_weights`."""
    element = np.maximum(size_element(tangents), 1e-300)
    total = float((base * element).sum())
    weights = base * element / total
    d_element = base * (d_weights - float(d_weights @ weights)) / total
    if len(tangents) == 1:
        return (tangents[0] * (d_element / element)[:, None],)
    normal = np.cross(tangents[0], tangents[1]) * (d_element / element)[:, None]
    return np.cross(tangents[1], normal), np.cross(normal, tangents[0])


def grid_tangents(mean: Floats, grid: tuple[int, ...], periodic: tuple[bool, ...]) -> tuple[Floats, ...]:
    """Return central differences of (n_P, d) points on a tensor grid, per unit of the parameter, one array per direction."""
    field = mean.reshape(*grid, -1)
    out = []
    for axis, (n, wraps) in enumerate(zip(grid, periodic, strict=True)):
        if wraps:
            slope = (np.roll(field, -1, axis) - np.roll(field, 1, axis)) * (n / 2)
        else:
            slope = np.gradient(field, axis=axis) * (n - 1)
        out.append(slope.reshape(mean.shape))
    return tuple(out)


def grid_size_weights(mean: Floats, grid: tuple[int, ...], periodic: tuple[bool, ...]) -> Floats:
    """Return the (n_P,) share of length or area that every point of an evenly spaced grid stands for; ends count half.

    Examples
    --------
    >>> grid_size_weights(np.array([[0.0, 0], [1, 0], [2, 0]]), (3,), (False,))
    array([0.25, 0.5 , 0.25])
    """
    ends = [np.ones(n) for n in grid]
    for e, wraps in zip(ends, periodic, strict=True):
        if not wraps:
            e[[0, -1]] = 0.5
    base = ends[0] if len(ends) == 1 else np.multiply.outer(ends[0], ends[1]).ravel()
    return size_weights(base, grid_tangents(mean, grid, periodic))
