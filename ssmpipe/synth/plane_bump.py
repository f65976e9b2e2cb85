"""Planes with a Gaussian bump that moves along x (Li 2015, section 2.3.2, [2.24]): surfaces with a known mode.

The formula, degree 2, 11 x 11 control points and four evenly spaced bumps are printed in the thesis. The dimensions are
ours: a square of side 60, height 20, standard deviation 6, which puts the feature points of its figure 2.16 near the printed
parameters (0.45, 0.5) and 0.28 beside. Parameters follow the arc length of the two profiles through the peak, for low
distortion; of four shapes each bump lies one knot span after the one before, so that they are approximated alike.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.synth._cohort import arc_parameters, shape_ids, write_splines

SIDE, HEIGHT, SIGMA = 60.0, 20.0, 6.0
DEGREE, N_CONTROL, N_SAMPLES = 2, 11, 201
FEATURES = ("peak", "base left", "base right", "base front", "base back")
BASE = 2.0
"""The base points lie this many standard deviations beside the peak."""

_DENSE = np.linspace(0.0, SIDE, 20001)


def profile_parameters(mean: float) -> Floats:
    """Return the share of arc length at 20001 even places across the bump, the profile through the peak."""
    z = HEIGHT * np.exp(-((_DENSE - mean) ** 2) / (2 * SIGMA**2))
    return arc_parameters(np.column_stack([_DENSE, z]))


def bump(mean: float) -> BSplineSurface:
    """Return the fitted surface with its peak at ``(mean, side / 2)``."""
    even = np.linspace(0.0, 1.0, N_SAMPLES)
    x = np.interp(even, profile_parameters(mean), _DENSE)[:, None]
    y = np.interp(even, profile_parameters(0.5 * SIDE), _DENSE)[None]
    z = HEIGHT * np.exp(-((x - mean) ** 2 + (y - 0.5 * SIDE) ** 2) / (2 * SIGMA**2))
    samples = np.stack([np.broadcast_to(x, z.shape), np.broadcast_to(y, z.shape), z], axis=-1)
    return fit_surface(samples, degree=(DEGREE, DEGREE), n_control=(N_CONTROL, N_CONTROL))


def write_cohort(out_dir: Path, n: int = 4, seed: int = 0) -> None:
    """Write the surfaces and the parameters of their features.

    Parameters
    ----------
    out_dir : Path
        Gets ``scans/<id>.npz``, ``landmarks.csv`` (peak and four base points) and ``truth.npz``: ``means`` (n,), ``features``
        (n, 5, 2) parameters, ``u`` (1001,) and ``desired_u`` (n, 1001), the first component of a desired reparameterization
        with shape 2 as reference (the bump moves as a whole, what is beside it is stretched; the second is the identity).
    n : int, default=4
        Bump centres are spread evenly over three knot spans around the middle.
    seed : int
        Without effect: nothing is random.
    """
    z = HEIGHT * np.exp(-((_DENSE - 0.5 * SIDE) ** 2) / (2 * SIGMA**2))
    whole = float(np.linalg.norm(np.diff(np.column_stack([_DENSE, z]), axis=0), axis=1).sum())
    means = 0.5 * SIDE + np.linspace(-1.5, 1.5, n) * whole / (N_CONTROL - DEGREE)
    surfaces = [bump(mean) for mean in means]
    beside = BASE * SIGMA * np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]])
    across = profile_parameters(0.5 * SIDE)
    features = np.stack(
        [
            np.column_stack(
                [
                    np.interp(mean + beside[:, 0], _DENSE, profile_parameters(mean)),
                    np.interp(0.5 * SIDE + beside[:, 1], _DENSE, across),
                ]
            )
            for mean in means
        ]
    )
    grid = np.linspace(0.0, 1.0, 1001)
    first = means[min(1, n - 1)]
    x = np.interp(grid, profile_parameters(first), _DENSE)
    desired = []
    for mean in means:
        moved = np.interp(x, [0, first - 2.5 * SIGMA, first + 2.5 * SIGMA, SIDE], _edges(mean))
        desired.append(np.interp(moved, _DENSE, profile_parameters(mean)))
    write_splines(
        Path(out_dir),
        shape_ids("plane_bump", n),
        surfaces,
        FEATURES,
        np.stack([_points(s, f) for s, f in zip(surfaces, features, strict=True)]),
        {"means": means, "features": features, "u": grid, "desired_u": np.stack(desired)},
        {
            "source": "Li 2015, section 2.3.2, [2.24]",
            "printed": {"degree": DEGREE, "n_control": [N_CONTROL, N_CONTROL], "shapes": 4},
            "ours": {"side": SIDE, "height": HEIGHT, "sigma": SIGMA, "means": means.tolist()},
            "reference": shape_ids("plane_bump", n)[min(1, n - 1)],
        },
    )


def _edges(mean: float) -> list[float]:
    return [0.0, mean - 2.5 * SIGMA, mean + 2.5 * SIGMA, SIDE]


def _points(surface: BSplineSurface, parameters: Floats) -> Floats:
    basis_u = design_matrix(parameters[:, 0], surface.knots_u, DEGREE)
    basis_v = design_matrix(parameters[:, 1], surface.knots_v, DEGREE)
    return np.asarray(np.einsum("na,abd,nb->nd", basis_u, surface.control_points, basis_v))
