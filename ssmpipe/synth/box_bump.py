"""Boxes with a bump that slides along the top (Li 2015, section 2.3.1): curves with a known reparameterization.

Box 60 x 20 and bump centres at 15, 25, 35, 45 are printed in the thesis. The bump itself is not: ours is a semicircle of
radius 12, which puts the corners of the bump and of the box at the parameters that its figure 2.6 names, within 0.01
for four of the five.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.fit_curve import curve_points, fit_curve
from ssmpipe.synth._cohort import shape_ids, write_splines

LENGTH, HEIGHT, RADIUS = 60.0, 20.0, 12.0
REFERENCE = 1
"""Index of the shape that the desired reparameterizations refer to, as in the thesis (its shape 2)."""

FEATURES = ("start", "lower right", "upper right", "bump right", "bump top", "bump left", "upper left", "end")
N_CONTROL = 160


def feature_lengths(centre: float) -> Floats:
    """Return the arc lengths of the features, counter-clockwise from the lower left corner, (8,).

    Examples
    --------
    >>> feature_lengths(25.0).round(2).tolist()
    [0.0, 60.0, 80.0, 103.0, 121.85, 140.7, 153.7, 173.7]
    """
    pieces = [LENGTH, HEIGHT, LENGTH - centre - RADIUS, np.pi * RADIUS / 2, np.pi * RADIUS / 2, centre - RADIUS, HEIGHT]
    return np.concatenate([[0.0], np.cumsum(pieces)])


def outline(centre: float, lengths: Floats) -> Floats:
    """Return the (n, 2) points of the sharp outline at arc lengths.

    Examples
    --------
    >>> outline(25.0, feature_lengths(25.0))[4].round(9).tolist()
    [25.0, 32.0]
    """
    marks = feature_lengths(centre)
    corners = np.array([[0, 0], [1, 0], [1, 1]]) * [LENGTH, HEIGHT]
    right, left = [centre + RADIUS, HEIGHT], [centre - RADIUS, HEIGHT]
    places = np.array([*corners, right, left, [0.0, HEIGHT], [0.0, 0.0]])
    known = np.delete(marks, 4)
    points = np.column_stack([np.interp(lengths, known, column) for column in places.T])
    angle = (lengths - marks[3]) / RADIUS
    arc = np.column_stack([centre + RADIUS * np.cos(angle), HEIGHT + RADIUS * np.sin(angle)])
    return np.where(((lengths > marks[3]) & (lengths < marks[5]))[:, None], arc, points)


def write_cohort(out_dir: Path, n: int = 4, seed: int = 0) -> None:
    """Write the curves and the desired reparameterizations.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.npz`` (quadratic, parameter = share of the arc length, start = end = lower left corner),
        ``landmarks.csv`` (the features) and ``truth.npz``: ``features`` (n, 8) parameters of the features, ``u`` (1001,) and
        ``desired`` (n, 1001), the reparameterization of each shape at ``u`` that brings it to correspondence with shape 2:
        linear between features [figure 2.6].
    n : int, default=4
        Bump centres are spread evenly from 15 to 45.
    seed : int
        Without effect: nothing is random.
    """
    centres = np.linspace(15.0, 45.0, n)
    u = np.linspace(0.0, 1.0, 1601)
    curves = [
        fit_curve(outline(c, u * feature_lengths(c)[-1]), degree=2, n_control=N_CONTROL, parameters=u) for c in centres
    ]
    features = np.stack([feature_lengths(c) / feature_lengths(c)[-1] for c in centres])
    grid = np.linspace(0.0, 1.0, 1001)
    reference = features[min(REFERENCE, n - 1)]
    write_splines(
        Path(out_dir),
        shape_ids("box_bump", n),
        curves,
        FEATURES[1:-1],
        np.stack([curve_points(c, f[1:-1]) for c, f in zip(curves, features, strict=True)]),
        {
            "centres": centres,
            "feature_names": np.array(FEATURES),
            "features": features,
            "u": grid,
            "desired": np.stack([np.interp(grid, reference, f) for f in features]),
        },
        {
            "source": "Li 2015, section 2.3.1",
            "printed": {"length": LENGTH, "height": HEIGHT, "centres of four shapes": [15, 25, 35, 45]},
            "ours": {"bump": f"semicircle of radius {RADIUS:g}", "degree": 2, "n_control": N_CONTROL},
            "reference": shape_ids("box_bump", n)[min(REFERENCE, n - 1)],
        },
    )
