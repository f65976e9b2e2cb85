"""The constraint ``J > floor`` as a barrier: on every coefficient, or on their Kreisselmeier-Steinhauser aggregate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import logsumexp, softmax

from ssmpipe.core.arrays import Floats

Aggregate = Literal["each", "ks"]


@dataclass(frozen=True)
class Barrier:
    """Logarithmic barrier on the (n_S, n) coefficients of the Jacobians.

    Parameters
    ----------
    aggregate : {"each", "ks"}
        ``each``: ``- mu / n sum_z log(J_z - floor)`` per shape. ``ks``: ``- mu log(-g)`` with one constraint per shape,
        ``g = (1/K) log sum_z exp(-K (J_z - floor)) < 0`` (Kreisselmeier and Steinhauser 1979; Li 2015, [2.22]).
    floor : float
    sharpness : float
        ``K``. ``g`` is above the true maximum by at most ``log(n) / K``.

    Examples
    --------
    >>> round(Barrier("each").value(np.full((1, 4), 0.5)), 6)
    0.693147
    >>> round(float(Barrier("ks", sharpness=15.0).constraint(np.ones((1, 2601)))[0]), 3)
    -0.476
    """

    aggregate: Aggregate = "each"
    floor: float = 0.0
    sharpness: float = 15.0

    def constraint(self, jacobians: Floats) -> Floats:
        """Return the constraint per shape, negative when feasible: the largest ``floor - J_z``, or ``g`` [2.22]."""
        slack = jacobians - self.floor
        if self.aggregate == "each":
            return np.asarray(-slack.min(axis=1))
        return np.asarray(logsumexp(-self.sharpness * slack, axis=1) / self.sharpness)

    def value(self, jacobians: Floats) -> float:
        """Return the barrier for ``mu = 1``; infinite outside the feasible set."""
        if self.aggregate == "each":
            slack = jacobians - self.floor
            return float(-np.log(slack).mean(axis=1).sum()) if slack.min() > 0 else np.inf
        margin = -self.constraint(jacobians)
        return float(-np.log(margin).sum()) if margin.min() > 0 else np.inf

    def slope(self, jacobians: Floats) -> Floats:
        """Return the derivative in every coefficient, (n_S, n) [2.23]."""
        slack = jacobians - self.floor
        if self.aggregate == "each":
            return np.asarray(-1.0 / (slack.shape[1] * slack))
        margin = -self.constraint(jacobians)
        return np.asarray(-softmax(-self.sharpness * slack, axis=1) / margin[:, None])

    def slope_along(self, jacobians: Floats, change: Floats) -> Floats:
        """Return the derivative of :meth:`slope` along ``change``, (n_S, n); exact."""
        slack = jacobians - self.floor
        if self.aggregate == "each":
            return np.asarray(change / (slack.shape[1] * slack**2))
        share = softmax(-self.sharpness * slack, axis=1)
        margin = -self.constraint(jacobians)[:, None]
        mean = (share * change).sum(axis=1, keepdims=True)
        return np.asarray(share * (self.sharpness * (change - mean) / margin + mean / margin**2))

    def curvature(self, jacobians: Floats) -> Floats:
        """Return a positive diagonal of the second derivative, (n_S, n), for Gauss-Newton blocks."""
        slack = jacobians - self.floor
        if self.aggregate == "each":
            return np.asarray(1.0 / (slack.shape[1] * slack**2))
        margin = -self.constraint(jacobians)
        return np.asarray(
            softmax(-self.sharpness * slack, axis=1) / margin[:, None] * (self.sharpness + 1.0 / margin[:, None])
        )
