"""Four quarter circles (Li 2015, [3.34]): covariances known in closed form.

The norm of the covariance matrix is 0.1284 by formulation I and 0.1200 by formulation II.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.spline.fit_curve import curve_points, fit_curve
from ssmpipe.synth._cohort import shape_ids, write_splines

N_POINTS, N_CONTROL = 100, 20


def arc(number: int, parameters: Floats) -> Floats:
    """Return the (n, 2) points of arc 0, 1, 2 or 3 at parameters in [0, 1]; the speed is constant.

    Examples
    --------
    >>> arc(1, np.array([0.0, 1.0])).round(12).tolist()
    [[0.0, 0.0], [1.0, 1.0]]
    """
    s, c = np.sin(0.5 * np.pi * parameters), np.cos(0.5 * np.pi * parameters)
    x, y = ((s, c), (1 - c, s), (1 - c, 1 - s), (s, 1 - c))[number]
    return np.column_stack([x, y])


def write_cohort(out_dir: Path, n: int = 4, seed: int = 0) -> None:
    """Write the arcs as quadratic splines of 20 control points, fitted to 100 points at equal angles.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.npz``, ``landmarks.csv`` (the middle of each arc) and ``truth.npz`` with ``norms`` (2,) of the
        covariance by formulations I and II, printed values.
    n : int, default=4
        Only 4 is possible.
    seed : int
        Without effect: nothing is random.

    Raises
    ------
    ConfigError
        If another number is asked for.
    """
    if n != 4:
        raise ConfigError(f"arcs has exactly 4 shapes, not {n}", "leave out --n")
    u = np.linspace(0.0, 1.0, N_POINTS)
    curves = [fit_curve(arc(k, u), degree=2, n_control=N_CONTROL, parameters=u) for k in range(4)]
    middle = np.array([0.5])
    write_splines(
        Path(out_dir),
        shape_ids("arc", 4),
        curves,
        ("middle",),
        np.stack([curve_points(c, middle) for c in curves]),
        {"norms": np.array([0.1284, 0.1200])},
        {
            "source": "Li 2015, section 3.4.1, [3.34]",
            "printed": {"norm of C, formulation I": 0.1284, "norm of C, formulation II": 0.1200},
            "ours": {"degree": 2, "n_control": N_CONTROL, "n_points": N_POINTS},
        },
    )
