"""Arc length along a B-spline curve."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import breakpoints


def arc_length_at(curve: BSplineCurve, parameters: Floats, *, n_nodes: int = 8) -> tuple[Floats, float]:
    """Return the arc length from ``u = 0`` to each parameter, and the whole length.

    Parameters
    ----------
    curve : BSplineCurve
    parameters : (n,) float64
        In [0, 1], in any order.
    n_nodes : int, default=8
        Gauss nodes between neighbouring knots and parameters.

    Returns
    -------
    lengths : (n,) float64
        In the unit of the control points.
    total : float

    Examples
    --------
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.]), np.array([[0, 0], [3, 4.]]))
    >>> arc_length_at(line, np.array([0.5, 1.0]))
    (array([2.5, 5. ]), 5.0)
    """
    ends = np.union1d(breakpoints(curve.knots), parameters)
    nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
    half = 0.5 * np.diff(ends)[:, None]
    at = 0.5 * (ends[1:] + ends[:-1])[:, None] + half * nodes
    speed = np.linalg.norm(
        design_matrix(at.ravel(), curve.knots, curve.degree, 1) @ curve.control_points, axis=1
    ).reshape(at.shape)
    lengths = np.concatenate([[0.0], np.cumsum((half * speed) @ weights)])
    return lengths[np.searchsorted(ends, parameters)], float(lengths[-1])
