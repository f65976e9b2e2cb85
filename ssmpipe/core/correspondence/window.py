"""The part of the parameter domain that a model covers where rims do not correspond: shapes that were cut at other places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError


@dataclass(frozen=True)
class Window:
    """``D`` of the reference: the affine map of the unit square onto ``[low, high]``, direction by direction.

    An edge that the window leaves is open: the maps of the other shapes may place it anywhere inside of their domain.

    Parameters
    ----------
    low, high : tuple of float
        Per direction. A periodic direction has 0 and 1.

    Raises
    ------
    GeometryError
        Unless ``0 <= low < high <= 1``.

    Examples
    --------
    >>> window = Window((0.0, 0.0), (1.0, 0.9))
    >>> window.open_edges
    ((1, -1),)
    >>> window.image(np.array([[0.5, 1.0]]))
    array([[0.5, 0.9]])
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(0.0 <= a < b <= 1.0 for a, b in zip(self.low, self.high, strict=True)):
            raise GeometryError(f"a window from {self.low} to {self.high} is no part of the unit square")

    @property
    def extent(self) -> Floats:
        """Length per direction, (d_par,)."""
        return np.subtract(self.high, self.low)

    @property
    def open_edges(self) -> tuple[tuple[int, int], ...]:
        """Direction and end (0 or -1) of every edge that does not lie on the edge of the domain."""
        found = [(axis, 0) for axis, a in enumerate(self.low) if a > 0.0]
        return tuple(found + [(axis, -1) for axis, b in enumerate(self.high) if b < 1.0])

    def image(self, u: Floats) -> Floats:
        """Return where (..., d_par) parameters of the model lie on the reference."""
        return np.asarray(self.low + self.extent * u)


def whole(n_directions: int) -> Window:
    """Return the window that covers everything.

    Examples
    --------
    >>> whole(2).open_edges
    ()
    """
    return Window((0.0,) * n_directions, (1.0,) * n_directions)


class Bounds:
    """What keeps open edges inside of the domain: linear inequalities ``(o + s b) / w > 0`` on coefficients of ``D``.

    A spline lies in the convex hull of its coefficients, so an edge whose coefficients lie inside lies inside. ``w`` is the
    margin that the reference has there, so that every slack of the reference is 1, as its Jacobian is.

    Parameters
    ----------
    n_coefficients : tuple of int
    window : Window

    Attributes
    ----------
    n : int
        Number of inequalities.

    Examples
    --------
    >>> bounds = Bounds((5, 4), Window((0.0, 0.0), (1.0, 0.9)))
    >>> b = np.full((1, 5, 4, 2), 0.95)
    >>> bounds.slack(b).round(12)
    array([[0.5, 0.5, 0.5, 0.5, 0.5]])
    """

    def __init__(self, n_coefficients: tuple[int, ...], window: Window) -> None:
        number = np.arange(np.prod(n_coefficients) * len(n_coefficients)).reshape(*n_coefficients, -1)
        places: list[Ints] = [np.empty(0, dtype=np.int64)]
        slopes, offsets = [np.empty(0)], [np.empty(0)]
        for axis, end in window.open_edges:
            edge = np.take(number[..., axis], end, axis=axis).ravel()
            margin = window.low[axis] if end == 0 else 1.0 - window.high[axis]
            sign = 1.0 if end == 0 else -1.0
            places.append(edge)
            slopes.append(np.full(len(edge), sign / margin))
            offsets.append(np.full(len(edge), 0.0 if end == 0 else 1.0 / margin))
        self._place = np.concatenate(places)
        self._slope = np.concatenate(slopes)
        self._offset = np.concatenate(offsets)
        self.n = len(self._place)

    def slack(self, coefficients: Floats) -> Floats:
        """Return the (n_S, n) slacks of (n_S, *n_b, d_par) coefficients."""
        return np.asarray(self._offset + self.along(coefficients))

    def along(self, direction: Floats) -> Floats:
        """Return the change of the slacks along (n_S, *n_b, d_par), (n_S, n); there is no second one."""
        return np.asarray(self._slope * direction.reshape(len(direction), -1)[:, self._place])

    def pull_back(self, weights: Floats, shape: tuple[int, ...]) -> Floats:
        """Return ``sum_z weights_z d slack_z/db`` from (n_S, n), in a ``shape`` of (n_S, *n_b, d_par)."""
        out = np.zeros((len(weights), int(np.prod(shape[1:]))))
        out[:, self._place] = self._slope * weights  # no coefficient has two bounds
        return out.reshape(shape)

    def curvature(self, weights: Floats, size: int) -> Floats:
        """Return the diagonal of ``sum_z weights_z (d slack_z/db)^2``, (n_S, size), from (n_S, n)."""
        out = np.zeros((len(weights), size))
        out[:, self._place] = self._slope**2 * weights
        return out
