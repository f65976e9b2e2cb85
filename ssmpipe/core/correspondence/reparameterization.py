"""The reparameterization ``D`` of the unit square: a tensor-product B-spline whose coefficients are the unknowns."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.knots import clamped_uniform_knots, greville

Boundary = Literal["fixed", "sliding"]


class Reparameterization:
    """Evaluate ``D_i(u_l)`` [2.3 of Li 2015] on a landmark grid for many shapes at once, and pull gradients back.

    Parameters
    ----------
    n_coefficients : (int, int)
        Coefficients ``n_b1, n_b2`` of ``D`` per direction.
    grid : (int, int)
        Landmarks per direction, evenly spaced in the parameter domain, ends included.
    degree : int, default=2
    boundary : {"fixed", "sliding"}, default="fixed"
        ``fixed``: ``D`` is the identity on the boundary [2.4]. ``sliding``: every edge is mapped onto itself, but points
        may slide along it; the corners stay.

    Attributes
    ----------
    free : (n_b1, n_b2, 2) bool
        Which coefficients are unknowns.

    Examples
    --------
    >>> D = Reparameterization((5, 5), (3, 3))
    >>> D.evaluate(D.identity()[None])[0, :3]
    array([[0. , 0. ],
           [0. , 0.5],
           [0. , 1. ]])
    """

    def __init__(
        self, n_coefficients: tuple[int, int], grid: tuple[int, int], *, degree: int = 2, boundary: Boundary = "fixed"
    ) -> None:
        self.degree = degree
        self.grid = grid
        self.boundary = boundary
        self.knots = tuple(clamped_uniform_knots(n, degree) for n in n_coefficients)
        nodes = tuple(np.linspace(0.0, 1.0, n) for n in grid)
        self._basis = tuple(design_matrix(u, k, degree) for u, k in zip(nodes, self.knots, strict=True))
        self.free = free_coefficients(n_coefficients, boundary)

    @property
    def n_coefficients(self) -> tuple[int, int]:
        """Coefficients per direction."""
        return self._basis[0].shape[1], self._basis[1].shape[1]

    def identity(self) -> Floats:
        """Return the (n_b1, n_b2, 2) coefficients of the identity: the Greville abscissae."""
        u, v = (greville(k, self.degree) for k in self.knots)
        return np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)

    def evaluate(self, coefficients: Floats) -> Floats:
        """Return ``D_i(u_l)``: (n_S, n_b1, n_b2, 2) coefficients to (n_S, n_P, 2) parameters, clipped to the square.

        Clipping removes rounding only: a B-spline with coefficients in the unit square stays in it.
        """
        moved = np.moveaxis(coefficients, -1, 1)
        values = self._basis[0] @ moved @ self._basis[1].T
        return np.clip(np.moveaxis(values, 1, -1).reshape(len(coefficients), -1, 2), 0.0, 1.0)

    def pull_back(self, gradient: Floats) -> Floats:
        """Return ``df/db`` (n_S, n_b1, n_b2, 2) from ``df/dD(u_l)`` (n_S, n_P, 2); the transpose of :meth:`evaluate`."""
        field = np.moveaxis(gradient.reshape(len(gradient), *self.grid, 2), -1, 1)
        return np.moveaxis(self._basis[0].T @ field @ self._basis[1], 1, -1)

    def normal_blocks(self, metric: Floats) -> Floats:
        """Return ``Basis^T M Basis`` for one shape: the Gauss-Newton block in all coefficients.

        Parameters
        ----------
        metric : (n_P, 3) float64
            The entries (uu, uv, vv) of a symmetric 2 x 2 matrix at every landmark.

        Returns
        -------
        (n_b1 * n_b2 * 2, n_b1 * n_b2 * 2) float64
        """
        nb1, nb2 = self.n_coefficients
        field = metric.reshape(*self.grid, 3)
        inner = np.einsum("lb,klc,lm->kbmc", self._basis[1], field, self._basis[1], optimize=True)
        blocks = np.einsum("ka,kbmc,kn->abnmc", self._basis[0], inner, self._basis[0], optimize=True)
        out = np.empty((nb1, nb2, 2, nb1, nb2, 2))
        out[:, :, 0, :, :, 0] = blocks[..., 0]
        out[:, :, 0, :, :, 1] = blocks[..., 1]
        out[:, :, 1, :, :, 0] = blocks[..., 1]
        out[:, :, 1, :, :, 1] = blocks[..., 2]
        return out.reshape(nb1 * nb2 * 2, nb1 * nb2 * 2)


def free_coefficients(n_coefficients: tuple[int, int], boundary: Boundary) -> Bools:
    """Return the (n_b1, n_b2, 2) mask of unknowns for a boundary mode.

    Examples
    --------
    >>> int(free_coefficients((8, 8), "fixed").sum()), int(free_coefficients((8, 8), "sliding").sum())
    (72, 96)
    """
    free = np.ones((*n_coefficients, 2), dtype=bool)
    free[[0, -1], :, 0] = False
    free[:, [0, -1], 1] = False
    if boundary == "fixed":
        free[:, [0, -1], 0] = False
        free[[0, -1], :, 1] = False
    return free
