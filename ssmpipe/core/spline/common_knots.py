"""Splines with different knots written on the union of them, exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import Spline, check_comparable
from ssmpipe.core.spline.knots import find_spans
from ssmpipe.core.spline.surface import BSplineSurface

_SAME = 1e-12
"""Knots as near as this are one knot: a third is not the same number after 3 and after 6 steps."""


def on_common_knots(splines: Sequence[Spline]) -> Sequence[Spline]:
    """Return the same curves or surfaces with knots that all of them share, by knot insertion.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        Of one kind, degree and dimension.

    Returns
    -------
    sequence of BSplineCurve or BSplineSurface
        What was given where the knots agree to the bit.

    Raises
    ------
    GeometryError
        If kind, degree or dimension differ.

    Examples
    --------
    >>> line = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0.0], [4.0]]))
    >>> roof = BSplineCurve(1, np.array([0, 0, 0.25, 1, 1]), np.array([[0.0], [9.0], [0.0]]))
    >>> on_common_knots([line, roof])[0].control_points.ravel()
    array([0., 1., 4.])
    """
    check_comparable(splines)
    given = [s.knot_vectors for s in splines]
    if all(np.array_equal(a, b) for own in given for a, b in zip(own, given[0], strict=True)):
        return splines
    common = [_union(list(vectors)) for vectors in zip(*given, strict=True)]
    return [_written_on(spline, common) for spline in splines]


def insertion_matrix(knots: Floats, finer: Floats, degree: int) -> Floats:
    """Return the matrix from control points on ``knots`` to those of the same spline on ``finer`` (Cohen, Lyche and Riesenfeld 1980).

    Parameters
    ----------
    knots : (n + degree + 1,) float64
        Clamped.
    finer : (m + degree + 1,) float64
        Clamped; holds every one of ``knots`` at least as often.
    degree : int

    Returns
    -------
    (m, n) float64
        No entry is negative, rows sum to 1.

    Examples
    --------
    >>> insertion_matrix(np.array([0, 0, 0, 1, 1, 1.0]), np.array([0, 0, 0, 0.5, 1, 1, 1]), 2)
    array([[1. , 0. , 0. ],
           [0.5, 0.5, 0. ],
           [0. , 0.5, 0.5],
           [0. , 0. , 1. ]])
    """
    n, m = len(knots) - degree - 1, len(finer) - degree - 1
    span = find_spans(knots, degree, finer[:m])
    rows = np.arange(m)
    # polar form of the piece on each span, one argument after another; blocks[r] holds the weights of control point span - degree + r
    blocks = np.broadcast_to(np.eye(degree + 1), (m, degree + 1, degree + 1)).copy()
    for r in range(1, degree + 1):
        x = finer[rows + r]
        for j in range(degree, r - 1, -1):
            left, right = knots[span - degree + j], knots[span + j - r + 1]
            share = ((x - left) / (right - left))[:, None]
            blocks[:, j] = share * blocks[:, j] + (1.0 - share) * blocks[:, j - 1]
    matrix = np.zeros((m, n))
    for j in range(degree + 1):
        matrix[rows, span - degree + j] = blocks[:, degree, j]
    return matrix


def _union(vectors: Sequence[Floats]) -> Floats:
    """Return the knots of all vectors, each as often as in the vector that has it most often."""
    places = np.unique(np.concatenate(vectors))
    places = places[np.concatenate([[True], np.diff(places) > _SAME])]
    counts = np.max([np.bincount(_nearest(places, v), minlength=len(places)) for v in vectors], axis=0)
    return np.repeat(places, counts)


def _nearest(places: Floats, values: Floats) -> np.ndarray:
    """Return for every value the index of the last place that is not above it, or above it by rounding only."""
    return np.searchsorted(places, values + _SAME, side="right") - 1


def _written_on(spline: Spline, common: Sequence[Floats]) -> Spline:
    matrices = []
    for own, union, degree in zip(spline.knot_vectors, common, spline.degrees, strict=True):
        places = np.unique(union)
        matrices.append(insertion_matrix(places[_nearest(places, own)], union, degree))
    if isinstance(spline, BSplineSurface):
        control = np.einsum("ak,bl,kld->abd", *matrices, spline.control_points, optimize=True)
        return BSplineSurface(spline.degree, common[0], common[1], control)
    return BSplineCurve(spline.degree, common[0], matrices[0] @ spline.control_points)
