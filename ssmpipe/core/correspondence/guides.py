"""Named landmarks as guides: the reparameterizations are pulled to carry them onto each other."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.correspondence.reparameterization import Reparameterization


class Guides:
    """Quadratic penalty ``sum_i sum_k weight |T_ik (D_i(u_k) - u_ik)|^2``.

    ``u_ik`` is where landmark k lies in the domain of shape i, ``u_k`` the common place, and ``T_ik`` the tangents of the
    surface at the landmark, so that the distance is measured on the surface [mm].

    Parameters
    ----------
    reparameterization : Reparameterization
    common : (n_K, d_par) float64
        ``u_k``.
    own : (n_S, n_K, d_par) float64
        ``u_ik``; rows of missing landmarks may hold anything finite.
    tangents : (n_S, n_K, d_par, d) float64
        Derivatives of the shapes at ``u_ik`` [mm].
    present : (n_S, n_K) bool
    weight : float
        [nat / mm^2].

    Attributes
    ----------
    rows : (n_K, prod(n_b)) float64
        Basis of one component of ``D`` at the common places.
    """

    def __init__(
        self,
        reparameterization: Reparameterization,
        common: Floats,
        own: Floats,
        tangents: Floats,
        present: Bools,
        weight: float,
    ) -> None:
        self.common = common
        self.own = own
        self._periodic = np.array(reparameterization.periodic)
        self.present = present
        self.rows = reparameterization.rows_at(common)
        self._identity = reparameterization.identity()
        self._metric = 2.0 * weight * np.einsum("ikad,ikbd->ikab", tangents, tangents) * present[..., None, None]

    def residual(self, coefficients: Floats) -> Floats:
        """Return ``D_i(u_k) - u_ik`` (n_S, n_K, d_par), the short way round in periodic directions."""
        flat = (coefficients - self._identity).reshape(len(coefficients), -1, self.common.shape[1])
        residual = self.common + self.rows @ flat - self.own
        return np.where(self._periodic, residual - np.round(residual), residual)

    def value_and_gradient(self, coefficients: Floats) -> tuple[float, Floats]:
        """Return the penalty and its gradient in the (n_S, *n_b, d_par) coefficients."""
        residual = self.residual(coefficients)
        force = np.einsum("ikab,ikb->ika", self._metric, residual)
        gradient = self.rows.T @ force
        return 0.5 * float((force * residual).sum()), gradient.reshape(coefficients.shape)

    def curvature_along(self, direction: Floats) -> Floats:
        """Return the exact second derivative times (n_S, *n_b, d_par)."""
        moved = self.rows @ direction.reshape(len(direction), -1, self.common.shape[1])
        return np.asarray(self.rows.T @ np.einsum("ikab,ikb->ika", self._metric, moved)).reshape(direction.shape)

    def hessian(self, i: int) -> Floats:
        """Return the exact second derivative for shape ``i``, (n, n), components fastest."""
        blocks = np.einsum("km,kab,kn->manb", self.rows, self._metric[i], self.rows, optimize=True)
        size = blocks.shape[0] * blocks.shape[1]
        return np.asarray(blocks.reshape(size, size))
