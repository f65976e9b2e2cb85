"""B-spline curve: knots, degree, control points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, frozen
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.knots import check_clamped_knots


@dataclass(frozen=True, eq=False)
class BSplineCurve:
    """Clamped B-spline curve ``S(u) = sum B_k(u) P_k`` on the unit interval (Li 2015, sec. 2.1).

    A closed curve is one whose first and last control points agree; it is evaluated with ``u`` modulo 1 where a
    periodic domain is asked for.

    Parameters
    ----------
    degree : int
    knots : (n + degree + 1,) float64
        Clamped, non-decreasing, from 0 to 1.
    control_points : (n, d) float64

    Raises
    ------
    GeometryError
        If the knot vector has the wrong length, decreases, or is not clamped to [0, 1].

    Examples
    --------
    >>> BSplineCurve(1, np.array([0, 0, 1, 1.]), np.zeros((2, 2))).dimension
    2
    """

    degree: int
    knots: Floats
    control_points: Floats

    def __post_init__(self) -> None:
        control = np.asarray(self.control_points, dtype=np.float64)
        if control.ndim != 2 or not np.isfinite(control).all():
            raise GeometryError(f"control_points: need finite numbers of shape (n, d), got shape {control.shape}")
        object.__setattr__(self, "degree", int(self.degree))
        knots = np.asarray(self.knots, dtype=np.float64)
        check_clamped_knots(knots, self.degree, len(control), "knots")
        object.__setattr__(self, "knots", frozen(knots, np.float64))
        object.__setattr__(self, "control_points", frozen(control, np.float64))

    def with_control(self, control_points: Floats) -> BSplineCurve:
        """Return the curve on the same knots with other (n, d) control points."""
        return BSplineCurve(self.degree, self.knots, control_points)

    @property
    def dimension(self) -> int:
        """Dimension d of the space the curve lives in."""
        return int(self.control_points.shape[1])

    @property
    def degrees(self) -> tuple[int]:
        """Degrees per direction, as a surface has them."""
        return (self.degree,)

    @property
    def knot_vectors(self) -> tuple[Floats]:
        """Knot vectors per direction, as a surface has them."""
        return (self.knots,)
