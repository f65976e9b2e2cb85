"""Lines with a bump that slides along (Li 2015, section 3.4.3): open quadratic curves of 12 control points.

Degree, control points and four shapes are printed in the thesis. The dimensions are ours: a line of length 60 with half an
ellipse, 20 wide and 20 high. Of four shapes each bump lies one knot span of arc length after the one before, so that they
are approximated alike.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.fit_curve import curve_points, fit_curve
from ssmpipe.synth._cohort import arc_parameters, shape_ids, write_splines

LENGTH, HALF_WIDTH, HEIGHT = 60.0, 10.0, 20.0
DEGREE, N_CONTROL = 2, 12
FEATURES = ("start", "bump left", "bump top", "bump right", "end")
_N = 4000


def profile(centre: float) -> tuple[Floats, Floats]:
    """Return dense points (n, 2) of the sharp profile and the (5,) indices of its features.

    Examples
    --------
    >>> points, marks = profile(30.0)
    >>> points[marks].round(9).tolist()
    [[0.0, 0.0], [20.0, 0.0], [30.0, 20.0], [40.0, 0.0], [60.0, 0.0]]
    """
    angle = np.linspace(np.pi, 0.0, 2 * _N + 1)
    bump = np.column_stack([centre + HALF_WIDTH * np.cos(angle), HEIGHT * np.sin(angle)])
    left = np.column_stack([np.linspace(0.0, centre - HALF_WIDTH, _N, endpoint=False), np.zeros(_N)])
    right = np.column_stack([np.linspace(LENGTH, centre + HALF_WIDTH, _N, endpoint=False)[::-1], np.zeros(_N)])
    return np.concatenate([left, bump, right]), np.array([0, _N, 2 * _N, 3 * _N, 4 * _N])


def write_cohort(out_dir: Path, n: int = 4, seed: int = 0) -> None:
    """Write the curves and the parameters of their features.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.npz`` (parameter = share of the arc length), ``landmarks.csv`` and ``truth.npz``: ``features`` (n, 5)
        parameters, ``u`` (1001,) and ``desired`` (n, 1001), linear between features, with shape 2 as reference.
    n : int, default=4
        Bump centres are spread evenly over three knot spans around the middle.
    seed : int
        Without effect: nothing is random.
    """
    points, _ = profile(0.5 * LENGTH)
    span = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) / (N_CONTROL - DEGREE)
    centres = 0.5 * LENGTH + np.linspace(-1.5, 1.5, n) * span
    curves, features = [], []
    for centre in centres:
        points, marks = profile(centre)
        u = arc_parameters(points)
        even = np.linspace(0.0, 1.0, 2001)
        data = np.column_stack([np.interp(even, u, column) for column in points.T])
        curves.append(fit_curve(data, degree=DEGREE, n_control=N_CONTROL, parameters=even))
        features.append(u[marks])
    grid = np.linspace(0.0, 1.0, 1001)
    reference = features[min(1, n - 1)]
    write_splines(
        Path(out_dir),
        shape_ids("line_bump", n),
        curves,
        FEATURES[1:-1],
        np.stack([curve_points(c, f[1:-1]) for c, f in zip(curves, features, strict=True)]),
        {
            "centres": centres,
            "feature_names": np.array(FEATURES),
            "features": np.stack(features),
            "u": grid,
            "desired": np.stack([np.interp(grid, reference, f) for f in features]),
        },
        {
            "source": "Li 2015, section 3.4.3",
            "printed": {"degree": DEGREE, "n_control": N_CONTROL, "shapes": 4},
            "ours": {"length": LENGTH, "bump": "half an ellipse", "half_width": HALF_WIDTH, "height": HEIGHT},
            "reference": shape_ids("line_bump", n)[min(1, n - 1)],
        },
    )
