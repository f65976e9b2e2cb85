"""Where a whole edge of a B-spline surface is one point: which ends are poles, and their tangent planes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import comb

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.knots import breakpoints
from ssmpipe.core.spline.surface import BSplineSurface

SurfaceTopology = Literal["disk", "tube", "cone", "closed"]
ROUNDING = 1e-9
"""Control points nearer than this are one point [mm]."""
_KINDS: tuple[SurfaceTopology, ...] = ("tube", "cone", "closed")


@dataclass(frozen=True, eq=False)
class TangentPlane:
    """How a surface meets one of its poles.

    Attributes
    ----------
    end : int
        0 for the pole at v = 0, -1 for the one at v = 1.
    normal : (3,) float64
        Unit, along S_u x S_v beside the pole: outward.
    deviation_deg : float
        Largest angle between S_v at the pole and the plane, over the control points of the second row; above zero the limits of
        the tangent planes along different u differ [deg].
    winding : float
        Lower bound, over all u, of the speed at which the projection of S_v turns about the normal, times its squared length;
        1 for a circle at even speed. Positive: S_v runs once around the pole and never back.
    """

    end: int
    normal: Floats
    deviation_deg: float
    winding: float


def surface_topology(surface: BSplineSurface) -> SurfaceTopology:
    """Tell from the control points what a surface is: it closes in u, and the edges v = 0 and v = 1 may be single points.

    A surface that does not close in u is a ``disk``.

    Examples
    --------
    >>> from ssmpipe.core.spline.knots import clamped_uniform_knots
    >>> ring = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0.0]])[:, None]
    >>> knots = clamped_uniform_knots(5, 2), clamped_uniform_knots(2, 1)
    >>> top = np.array([0, 0, 1.0])
    >>> surface_topology(BSplineSurface((2, 1), *knots, np.concatenate([ring, ring + top], axis=1)))
    'tube'
    >>> surface_topology(BSplineSurface((2, 1), *knots, np.concatenate([ring, 0 * ring + top], axis=1)))
    'cone'
    """
    control = surface.control_points
    if not np.allclose(control[0], control[-1], rtol=0, atol=ROUNDING):
        return "disk"
    return _KINDS[sum(is_pole(surface, end) for end in (0, -1))]


def is_pole(surface: BSplineSurface, end: int) -> bool:
    """Say whether the edge v = 0 (``end`` = 0) or v = 1 (``end`` = -1) is one point."""
    edge = surface.control_points[:, end]
    return bool(np.allclose(edge, edge[0], rtol=0, atol=ROUNDING))


def smooth_pole(control: Floats, end: int, circle: Floats) -> Floats:
    """Move the row of control points beside a pole onto an ellipse around it, so that the surface is smooth there.

    S_v at the pole points from the pole to the curve of that row. A differentiable surface has ``S_v = a cos 2 pi u + b sin 2 pi u``
    where u turns evenly about the pole, and as an affine image of that wherever u does so in some affine chart of the tangent
    plane; its plane is that of a and b, and the curve runs once around. The ellipse is the one nearest to the row.

    Parameters
    ----------
    control : (n_u, n_v, 3) float64
        With ``control[:, end]`` one point [mm].
    end : {0, -1}
    circle : (n_u, 2) float64
        Control points of the unit circle ``(cos 2 pi u, sin 2 pi u)`` in the same spline space.

    Returns
    -------
    (n_u, n_v, 3) float64

    Examples
    --------
    >>> u = np.linspace(0, 2 * np.pi, 9)
    >>> circle = np.stack([np.cos(u), np.sin(u)], axis=1)
    >>> rough = np.zeros((9, 3, 3))
    >>> rough[:, 1] = np.column_stack([2 * circle, 0.1 * np.cos(2 * u)])
    >>> bool(np.allclose(smooth_pole(rough, 0, circle)[:, 1], np.column_stack([2 * circle, 0 * u])))
    True
    """
    out = control.copy()
    row = 1 if end == 0 else -2
    axes = np.linalg.lstsq(circle[:-1], control[:-1, row] - control[0, end], rcond=None)[0]
    out[:, row] = control[0, end] + circle @ axes
    out[-1, row] = out[0, row]
    return out


def tangent_plane(surface: BSplineSurface, end: int) -> TangentPlane:
    """Measure whether the tangent plane at a pole is unique and the surface runs once around it.

    Two things suffice: the second row of control points lies in a plane through the pole, and its curve ``c(u)`` turns about the
    pole in one sense. The second is proved by the Bernstein coefficients of ``(c - pole) x c'`` on every span.
    """
    control = surface.control_points
    away = control[:, 1 if end == 0 else -2] - control[0, end]
    degree = surface.degree[0]
    ends = breakpoints(surface.knots_u)
    order = max(2 * degree - 1, 1)
    inside = (np.arange(order + 1) + 0.5) / (order + 1)
    at = (ends[:-1, None] + np.diff(ends)[:, None] * inside).ravel()
    curve = design_matrix(at, surface.knots_u, degree) @ away
    slope = design_matrix(at, surface.knots_u, degree, 1) @ away
    turning = np.cross(curve, slope)
    whole = turning.sum(axis=0)
    normal = np.linalg.svd(away[:-1], full_matrices=False)[2][2]
    normal = normal if normal @ whole >= 0 else -normal
    k = np.arange(order + 1)
    bernstein = comb(order, k) * inside[:, None] ** k * (1 - inside[:, None]) ** (order - k)
    coefficients = np.linalg.solve(bernstein, (turning @ normal).reshape(len(ends) - 1, order + 1).T)
    flat = away - np.multiply.outer(away @ normal, normal)
    length = np.linalg.norm(away, axis=1)
    sine = np.abs(away @ normal) / np.where(length > 0, length, np.inf)
    scale = 2.0 * np.pi * (flat**2).sum(axis=1).mean()
    return TangentPlane(
        end=end,
        normal=normal if end == -1 else -normal,
        deviation_deg=float(np.degrees(np.arcsin(np.clip(sine.max(), 0.0, 1.0)))),
        winding=float(coefficients.min() / scale) if scale > 0 else 0.0,
    )
