"""What the maps must keep positive: the coefficients of their Jacobians and, where edges are open, the room to the edge.

With open edges all of it is relative to the identity of the window, where every value is 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.jacobian import Jacobian, JacobianForm, LocalJacobian
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.window import Bounds


class Inequalities:
    """The Jacobian's coefficients, then the slacks of open edges, as one list with derivatives.

    Parameters
    ----------
    reparameterization : Reparameterization
    form : {"bezier", "bspline", "sampled"}

    Attributes
    ----------
    n_jacobian : int
        Number of coefficients of the Jacobian per shape, which come first.

    Examples
    --------
    >>> from ssmpipe.core.correspondence.window import Window
    >>> D = Reparameterization((5, 5), (3, 3), boundary="periodic", window=Window((0.0, 0.0), (1.0, 0.8)))
    >>> both = Inequalities(D, "bezier")
    >>> values = both.at(D.identity()[None]).values
    >>> values.shape[1] - both.n_jacobian, bool(np.allclose(values[:, both.n_jacobian :], 1))
    (5, True)
    """

    def __init__(self, reparameterization: Reparameterization, form: JacobianForm) -> None:
        self.jacobian = Jacobian(reparameterization, form)
        self.n_jacobian = self.jacobian.n
        self.bounds = Bounds(reparameterization.n_coefficients, reparameterization.window)
        self._free = reparameterization.free.ravel()
        self.area = float(np.prod(reparameterization.window.extent))

    def at(self, coefficients: Floats) -> LocalInequalities:
        """Return the list at (n_S, *n_b, d_par) coefficients, to be differentiated there."""
        return LocalInequalities(self, self.jacobian.at(coefficients), coefficients)

    def coefficients(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n) values alone."""
        return self.at(coefficients).values

    def normal_blocks(self, coefficients: Floats, curvature: Floats) -> Floats:
        """Return ``sum_z curvature_z dg_z/db dg_z/db^T`` of every shape, (n_S, m, m), in the m free coefficients."""
        if not self.bounds.n:
            return self.jacobian.normal_blocks(coefficients, curvature)
        blocks = self.jacobian.normal_blocks(coefficients, curvature[:, : self.n_jacobian] / self.area**2)
        diagonal = self.bounds.curvature(curvature[:, self.n_jacobian :], len(self._free))[:, self._free]
        places = np.arange(diagonal.shape[1])
        blocks[:, places, places] += diagonal
        return blocks


def centred_where_open(barrier: Barrier, reparameterization: Reparameterization) -> Barrier:
    """Return the barrier with its least value at the identity where edges are open: a logarithm alone would let all maps grow."""
    return replace(barrier, centred=True) if reparameterization.window.open_edges else barrier


class LocalInequalities:
    """The list at given coefficients of D, with its derivatives there; from :meth:`Inequalities.at`."""

    def __init__(self, of: Inequalities, jacobian: LocalJacobian, coefficients: Floats) -> None:
        self._of, self._jacobian, self._coefficients = of, jacobian, coefficients

    @property
    def values(self) -> Floats:
        """The (n_S, n) values."""
        bounds = self._of.bounds
        if not bounds.n:
            return self._jacobian.values
        return np.concatenate([self._jacobian.values / self._of.area, bounds.slack(self._coefficients)], axis=1)

    @property
    def jacobians(self) -> Floats:
        """The (n_S, n_jacobian) coefficients of the Jacobians themselves."""
        return self._jacobian.values

    def part(self, block: slice) -> LocalInequalities:
        """Return the same for some shapes."""
        return LocalInequalities(self._of, self._jacobian.part(block), self._coefficients[block])

    def along(self, direction: Floats) -> tuple[Floats, Floats]:
        """Return ``g1, g2`` with ``g(b + a d) = g(b) + a g1 + a^2 g2`` exactly."""
        first, second = self._jacobian.along(direction)
        bounds = self._of.bounds
        if not bounds.n:
            return first, second
        change, area = bounds.along(direction), self._of.area
        none = np.zeros_like(change)
        return np.concatenate([first / area, change], axis=1), np.concatenate([second / area, none], axis=1)

    def pull_back(self, weights: Floats) -> Floats:
        """Return ``sum_z weights_z dg_z/db``, (n_S, *n_b, d_par), from (n_S, n)."""
        n, bounds = self._of.n_jacobian, self._of.bounds
        if not bounds.n:
            return self._jacobian.pull_back(weights)
        out = self._jacobian.pull_back(weights[:, :n] / self._of.area)
        return out + bounds.pull_back(weights[:, n:], out.shape)

    def pull_back_along(self, direction: Floats, slope_along: Callable[[Floats], Floats], weights: Floats) -> Floats:
        """Return the change of :meth:`pull_back` of some weights along a direction.

        Parameters
        ----------
        direction : (n_S, *n_b, d_par)
        slope_along : callable
            Change of the list along the direction, (n_S, n), to the change of the weights.
        weights : (n_S, n)
            As they are here.
        """
        bounds, n, area = self._of.bounds, self._of.n_jacobian, self._of.area
        if not bounds.n:
            return self._jacobian.pull_back_along(direction, slope_along, weights)
        changed = slope_along(self.along(direction)[0])
        out = self._jacobian.pull_back_along(direction, lambda _: changed[:, :n] / area, weights[:, :n] / area)
        return out + bounds.pull_back(changed[:, n:], out.shape)
