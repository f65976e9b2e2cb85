"""Tensor-product B-spline surface: knots, degree, control net."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, frozen
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.knots import check_clamped_knots


@dataclass(frozen=True, eq=False)
class BSplineSurface:
    """Clamped tensor-product B-spline surface ``S(u, v) = sum B_k(u) B_l(v) P_kl`` on the unit square (Li 2015, sec. 2.1).

    Parameters
    ----------
    degree : (int, int)
        Degrees in u and v.
    knots_u, knots_v : (n_u + degree + 1,) float64
        Clamped, non-decreasing, from 0 to 1.
    control_points : (n_u, n_v, d) float64
        Control net [mm].

    Raises
    ------
    GeometryError
        If a knot vector has the wrong length, decreases, or is not clamped to [0, 1].

    Examples
    --------
    >>> BSplineSurface((1, 1), np.array([0, 0, 1, 1.]), np.array([0, 0, 1, 1.]), np.zeros((2, 2, 3))).dimension
    3
    """

    degree: tuple[int, int]
    knots_u: Floats
    knots_v: Floats
    control_points: Floats

    def __post_init__(self) -> None:
        control = np.asarray(self.control_points, dtype=np.float64)
        if control.ndim != 3 or not np.isfinite(control).all():
            raise GeometryError(
                f"control_points: need finite numbers of shape (n_u, n_v, d), got shape {control.shape}"
            )
        object.__setattr__(self, "degree", (int(self.degree[0]), int(self.degree[1])))
        for axis, name in enumerate(("knots_u", "knots_v")):
            knots = np.asarray(getattr(self, name), dtype=np.float64)
            check_clamped_knots(knots, self.degree[axis], control.shape[axis], name)
            object.__setattr__(self, name, frozen(knots, np.float64))
        object.__setattr__(self, "control_points", frozen(control, np.float64))

    def with_control(self, control_points: Floats) -> BSplineSurface:
        """Return the surface on the same knots with other (n_u, n_v, d) control points."""
        return BSplineSurface(self.degree, self.knots_u, self.knots_v, control_points)

    @property
    def dimension(self) -> int:
        """Dimension d of the space the surface lives in."""
        return int(self.control_points.shape[2])

    @property
    def degrees(self) -> tuple[int, int]:
        """Degrees per direction."""
        return self.degree

    @property
    def knot_vectors(self) -> tuple[Floats, Floats]:
        """Knot vectors per direction."""
        return (self.knots_u, self.knots_v)
