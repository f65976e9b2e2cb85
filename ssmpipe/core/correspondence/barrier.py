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
    centred : bool
        With ``each``: plus ``mu / n sum_z (J_z - 1) / (1 - floor)``, so that the barrier is least where every ``J_z`` is 1. Where edges
        stay, the mean of ``J`` is 1 and the term is nothing.

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
    centred: bool = False

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
            if slack.min() <= 0:
                return np.inf
            growth = float((jacobians - 1.0).mean(axis=1).sum()) / (1.0 - self.floor) if self.centred else 0.0
            return float(-np.log(slack).mean(axis=1).sum()) + growth
        margin = -self.constraint(jacobians)
        return float(-np.log(margin).sum()) if margin.min() > 0 else np.inf

    def margins(self, jacobians: Floats) -> Floats:
        """Return what must stay positive: the slack of every coefficient, (n_S, n), or ``-g``, (n_S, 1)."""
        return jacobians - self.floor if self.aggregate == "each" else -self.constraint(jacobians)[:, None]

    def multipliers(self, jacobians: Floats) -> Floats:
        """Return the multipliers of the margins that belong to the barrier with ``mu = 1``."""
        count = jacobians.shape[1] if self.aggregate == "each" else 1
        return np.asarray(1.0 / (count * self.margins(jacobians)))

    def followed(self, jacobians: Floats, change: Floats, multipliers: Floats, weight: float) -> Floats:
        """Return the multipliers after a Newton step of the primal-dual equations ``multiplier * margin = weight * const``.

        They go at most 99.5 % of the way to zero (Nocedal and Wright 2006, section 19.2).

        Parameters
        ----------
        jacobians, change : (n_S, n)
            Coefficients before the step, and their derivative along the full step.
        multipliers : (n_S, n) or (n_S, 1)
        weight : float
            ``mu``.
        """
        if self.aggregate == "ks":
            change = (self._shares(jacobians) * change).sum(axis=1, keepdims=True)
        aim = weight * self.multipliers(jacobians) - multipliers * change / self.margins(jacobians)
        fall = float((1.0 - aim / multipliers).max())
        return np.asarray(multipliers + min(1.0, 0.995 / max(fall, 0.995)) * (aim - multipliers))

    def slope(self, jacobians: Floats, multipliers: Floats | None = None, weight: float = 1.0) -> Floats:
        """Return the derivative in every coefficient, (n_S, n) [2.23], for ``mu = 1`` or with given multipliers of a ``weight``."""
        dual = self.multipliers(jacobians) if multipliers is None else multipliers
        if self.aggregate == "ks":
            return -self._shares(jacobians) * dual
        return weight / (jacobians.shape[1] * (1.0 - self.floor)) - dual if self.centred else -dual

    def slope_along(self, jacobians: Floats, change: Floats, multipliers: Floats) -> Floats:
        """Return the change of :meth:`slope` along ``change`` when multipliers answer, (n_S, n); exact at those of the barrier."""
        stiffness = multipliers / self.margins(jacobians)
        if self.aggregate == "each":
            return np.asarray(stiffness * change)
        share = self._shares(jacobians)
        mean = (share * change).sum(axis=1, keepdims=True)
        return np.asarray(share * (self.sharpness * multipliers * (change - mean) + stiffness * mean))

    def curvature(self, jacobians: Floats, multipliers: Floats) -> Floats:
        """Return a positive diagonal for :meth:`slope_along`, (n_S, n), for Gauss-Newton blocks."""
        stiffness = multipliers / self.margins(jacobians)
        if self.aggregate == "each":
            return np.asarray(stiffness)
        return np.asarray(self._shares(jacobians) * (self.sharpness * multipliers + stiffness))

    def _shares(self, jacobians: Floats) -> Floats:
        return np.asarray(softmax(-self.sharpness * (jacobians - self.floor), axis=1))
