"""Where landmarks lie in the parameter domain and what each one weighs in the covariance."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.covariance.formulation_two import size_weights
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
