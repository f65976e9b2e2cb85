"""Every method of the engine runs to a certified result on small cohorts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import FoldoverError, GeometryError, LandmarkError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.project import nearest_parameters
from tests.support.surfaces import bump, bumps

BASE = EngineOptions(n_coefficients=(6, 6), landmarks=(21, 21), normalize="none", pose="keep", lambda_cut=1e-3)


def closed_curve(shift: float, phase: float, n: int = 40) -> BSplineCurve:
    """Return a closed outline with one bump at angle ``shift``, starting at angle ``phase``."""
    t = np.linspace(0, 2 * np.pi, 400) + phase
    radius = 10 + 3 * np.exp(-(((t - shift + np.pi) % (2 * np.pi) - np.pi) ** 2) / 0.1)
    points = np.stack([1.5 * radius * np.cos(t), radius * np.sin(t)], axis=1)
    from scipy.interpolate import make_lsq_spline

    knots = clamped_uniform_knots(n, 3)
    control = make_lsq_spline(np.linspace(0, 1, 400), points, knots, k=3).c.copy()
    control[-1] = control[0] = 0.5 * (control[0] + control[-1])
    return BSplineCurve(3, knots, control)


@pytest.mark.parametrize(
    "changes",
    [
        {"boundary": "sliding"},
        {"covariance": "I"},
        {"covariance": "II", "quadrature": "gauss"},
        {"covariance": "II"},
        {"objective": "log-determinant"},
        {"objective": "trace", "lambda_cut": 1.0},
        {"form": "bspline"},
        {"form": "sampled"},
        {"aggregate": "ks", "sharpness": 30.0},
        {"reference": "none"},
        {"coarse_to_fine": True, "n_coefficients": (10, 10)},
        {"pose": "procrustes", "normalize": "size"},
        {"degree": 3},
        {"pose": "each-evaluation"},
        {"solver": "newton"},
        {"solver": "auto", "barriers": (10.0, 0.1)},
        {"sensitivity": "direct"},
    ],
    ids=str,
)
def test_method_lowers_its_objective_and_is_proved(changes):
    result = optimize_correspondence(bumps(4), replace(BASE, **changes))
    history = result.history["description_length"]
    assert history[-1] < history[0] - 0.5
    assert result.history["max_constraint"].max() < 0
    assert all(c.verdict == "proved" for c in result.value.certificates)


def test_direct_and_adjoint_reach_the_same_point():
    a, b = (optimize_correspondence(bumps(4), replace(BASE, sensitivity=s)).value for s in ("adjoint", "direct"))
    np.testing.assert_allclose(a.parameters, b.parameters, atol=1e-5)


def test_no_reference_keeps_the_mean_of_the_maps():
    optimum = optimize_correspondence(bumps(4), replace(BASE, reference="none")).value
    mean = optimum.coefficients.mean(axis=0)
    from ssmpipe.core.correspondence.reparameterization import Reparameterization

    np.testing.assert_allclose(mean, Reparameterization((6, 6), (3, 3)).identity(), atol=1e-10)


def test_closed_curves_find_their_starting_point():
    curves = [closed_curve(shift, phase) for shift, phase in ((0.5, 0.0), (0.6, 0.5), (0.7, -0.4), (0.4, 0.3))]
    options = EngineOptions(n_coefficients=(16,), landmarks=(80,), boundary="periodic", normalize="none", pose="keep")
    optimum = optimize_correspondence(curves, options).value
    before, after = (((p - p.mean(axis=0)) ** 2).sum() for p in (optimum.initial_points, optimum.points))
    assert after < 0.1 * before
    assert all(c.verdict == "proved" for c in optimum.certificates)
    tip = [p[np.linalg.norm(p, axis=1).argmax()] for p in optimum.points]
    index = [np.linalg.norm(p, axis=1).argmax() for p in optimum.points]
    assert np.ptp(index) <= 3, tip


def marked_bumps():
    centres = [(24.0, 30.0), (30.0, 33.0), (36.0, 27.0)]
    shapes = [bump(c, 20.0) for c in centres]
    return shapes, [{"top": np.array([*c, 20.0])} for c in centres]


def test_guides_pull_and_interpolate():
    shapes, marks = marked_bumps()
    free = optimize_correspondence(shapes, replace(BASE, barriers=(1e4,)), guides=None).value
    pulled = optimize_correspondence(shapes, replace(BASE, barriers=(1e4,), guide_weight=30.0), guides=marks).value
    hard = optimize_correspondence(shapes, replace(BASE, guide_mode="interpolate"), guides=marks).value
    assert np.nanmax(pulled.guide_residuals) < 5.0
    assert np.nanmax(hard.guide_residuals) <= 0.01
    assert all(c.verdict == "proved" for c in hard.certificates)
    assert np.abs(pulled.coefficients - free.coefficients).max() > 1e-3


def test_contradicting_guides_are_refused():
    shapes, marks = marked_bumps()
    crossed = [
        {"a": m["top"] + [-4.0, 0, 0], "b": m["top"] + [4.0, 0, 0]}
        if k
        else {"a": m["top"] + [4.0, 0, 0], "b": m["top"] + [-4.0, 0, 0]}
        for k, m in enumerate(marks)
    ]
    options = replace(BASE, guide_mode="interpolate", n_coefficients=(4, 4))
    with pytest.raises(FoldoverError, match="guides cannot all be met"):
        optimize_correspondence(shapes, options, guides=crossed)


def test_a_guide_on_one_shape_only_is_refused():
    shapes, marks = marked_bumps()
    with pytest.raises(LandmarkError, match="two shapes or more"):
        optimize_correspondence(shapes, BASE, guides=[marks[0], {}, {}])


def test_wrong_number_of_directions_is_refused():
    with pytest.raises(GeometryError, match="one number per parameter direction"):
        optimize_correspondence(bumps(3), EngineOptions(n_coefficients=(8,), landmarks=(51,)))


def test_nearest_parameters_recover_points_of_the_surface():
    surface = bump((30.0, 30.0), 20.0)
    from ssmpipe.core.spline.evaluate import SplineStack

    uv = np.random.default_rng(0).uniform(0.05, 0.95, size=(1, 40, 2))
    points = SplineStack([surface]).evaluate(uv).points[0]
    found, distance = nearest_parameters(surface, points)
    np.testing.assert_allclose(found, uv[0], atol=1e-6)
    assert distance.max() < 1e-6
