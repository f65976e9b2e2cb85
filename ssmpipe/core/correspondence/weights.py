"""Formulation II: every landmark weighs the area it stands for on the mean shape."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats


def trapezoid(grid: tuple[int, int]) -> Floats:
    """Return the (n_1, n_2) trapezoid weights: 1 inside, 1/2 on edges, 1/4 at corners.

    Examples
    --------
    >>> trapezoid((3, 2)).ravel()
    array([0.25, 0.25, 0.5 , 0.5 , 0.25, 0.25])
    """
    ends = [np.ones(n) for n in grid]
    for e in ends:
        e[[0, -1]] = 0.5
    return np.multiply.outer(ends[0], ends[1])


class MeanAreaWeights:
    """Area weights of the mean shape, normalized to sum 1, and their derivative (Li 2015, [1.25, 3.16]).

    The surface element ``|M_u x M_v|`` of the mean ``M`` is taken by central differences on the landmark grid, so that the
    derivative below is exact for the weights as computed.

    Parameters
    ----------
    grid : (int, int)

    Examples
    --------
    >>> flat = np.stack([*np.meshgrid(np.arange(3.0), np.arange(3.0), indexing="ij"), np.zeros((3, 3))], axis=-1)
    >>> MeanAreaWeights((3, 3)).value(flat.reshape(-1, 3)).reshape(3, 3)[1]
    array([0.125, 0.25 , 0.125])
    """

    def __init__(self, grid: tuple[int, int]) -> None:
        self.grid = grid
        self._slope_u: Floats = np.asarray(np.gradient(np.eye(grid[0]), axis=0))
        self._slope_v: Floats = np.asarray(np.gradient(np.eye(grid[1]), axis=0))
        self._cell = trapezoid(grid)

    def _tangents(self, mean: Floats) -> tuple[Floats, Floats, Floats]:
        surface = mean.reshape(*self.grid, 3)
        du = np.tensordot(self._slope_u, surface, axes=(1, 0))
        dv = np.einsum("lm,kmd->kld", self._slope_v, surface)
        return du, dv, np.cross(du, dv)

    def areas(self, mean: Floats) -> Floats:
        """Return the (n_P,) areas [mm^2] that the landmarks of the (n_P, 3) ``mean`` stand for."""
        return (np.linalg.norm(self._tangents(mean)[2], axis=-1) * self._cell).ravel()

    def value(self, mean: Floats) -> Floats:
        """Return the (n_P,) weights, sum 1."""
        areas = self.areas(mean)
        return areas / areas.sum()

    def pull_back(self, mean: Floats, d_weights: Floats) -> Floats:
        """Return ``df/dM`` (n_P, 3) from ``df/dw`` (n_P,)."""
        du, dv, cross = self._tangents(mean)
        length = np.linalg.norm(cross, axis=-1)
        total = float((length * self._cell).sum())
        weights = (length * self._cell).ravel() / total
        d_element = ((d_weights - float(d_weights @ weights)) / total).reshape(self.grid) * self._cell
        normal = cross / np.maximum(length, 1e-300)[..., None] * d_element[..., None]
        back_u = np.tensordot(self._slope_u.T, np.cross(dv, normal), axes=(1, 0))
        back_v = np.einsum("ml,kmd->kld", self._slope_v, np.cross(normal, du))
        return (back_u + back_v).reshape(-1, 3)
