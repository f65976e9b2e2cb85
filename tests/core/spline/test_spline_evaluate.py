import numpy as np
import pytest
from scipy.interpolate import BSpline, NdBSpline

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.surface import BSplineSurface


def random_surface(rng, degree, knots_u, knots_v):
    shape = (len(knots_u) - degree[0] - 1, len(knots_v) - degree[1] - 1, 3)
    return BSplineSurface(degree, knots_u, knots_v, rng.normal(size=shape))


@pytest.mark.parametrize("degree", [(1, 1), (2, 2), (3, 2), (4, 5)])
@pytest.mark.parametrize("uniform", [True, False])
def test_agrees_with_scipy_in_value_and_derivatives(degree, uniform):
    rng = np.random.default_rng(3)
    knots = []
    for p in degree:
        k = clamped_uniform_knots(p + 7, p)
        if not uniform:
            k[p + 1 : -p - 1] = np.sort(rng.random(len(k) - 2 * p - 2))
        knots.append(k)
    surfaces = [random_surface(rng, degree, *knots) for _ in range(3)]
    uv = rng.random((3, 200, 2))
    uv[:, :4] = [[0, 0], [1, 1], [1, 0], [0, 1]]
    uv[:, 4, 0] = knots[0][degree[0] + 2]
    jet = SplineStack(surfaces).evaluate(uv, second=True)
    points, (du, dv) = jet.points, jet.first
    for i, s in enumerate(surfaces):
        oracle = NdBSpline(tuple(knots), s.control_points, degree)
        inside = np.ones(200, bool)
        if min(degree) == 1:
            inside[:5] = False  # one-sided derivatives differ at a kink
        np.testing.assert_allclose(points[i], oracle(uv[i]), atol=1e-12)
        np.testing.assert_allclose(du[i][inside], oracle(uv[i][inside], nu=(1, 0)), atol=1e-9)
        np.testing.assert_allclose(dv[i][inside], oracle(uv[i][inside], nu=(0, 1)), atol=1e-9)
        if min(degree) > 2:
            for values, nu in zip(jet.second, ((2, 0), (1, 1), (0, 2)), strict=True):
                np.testing.assert_allclose(values[i], oracle(uv[i], nu=nu), atol=1e-6)
        elif degree == (2, 2):
            np.testing.assert_allclose(jet.second[1][i], oracle(uv[i], nu=(1, 1)), atol=1e-8)


def test_refuses_different_knots():
    rng = np.random.default_rng(0)
    a = random_surface(rng, (2, 2), clamped_uniform_knots(6, 2), clamped_uniform_knots(6, 2))
    b = random_surface(rng, (2, 2), clamped_uniform_knots(7, 2), clamped_uniform_knots(6, 2))
    with pytest.raises(GeometryError, match="spline 1 has other knots than spline 0"):
        SplineStack([a, b])


@pytest.mark.parametrize(
    ("knots", "words"),
    [
        (np.array([0, 0, 0, 1, 1.0]), "got 5 knots, need n_control \\+ degree \\+ 1 = 6"),
        (np.array([0, 0, 0, 1, 0.9, 1]), "must not decrease"),
        (np.array([0, 0, 0.1, 1, 1, 1]), "clamped"),
    ],
)
def test_surface_refuses_bad_knots(knots, words):
    good = clamped_uniform_knots(3, 2)
    with pytest.raises(GeometryError, match=words):
        BSplineSurface((2, 2), knots, good, np.zeros((3, 3, 3)))


@pytest.mark.parametrize("degree", [2, 3])
def test_curves_agree_with_scipy_and_wrap_when_periodic(degree):
    rng = np.random.default_rng(1)
    knots = clamped_uniform_knots(9, degree)
    control = rng.normal(size=(9, 2))
    control[-1] = control[0]
    u = rng.random((1, 100, 1))
    stack = SplineStack([BSplineCurve(degree, knots, control)], periodic=(True,))
    jet, shifted = stack.evaluate(u, second=True), stack.evaluate(u - 3.0)
    oracle = BSpline(knots, control, degree)
    np.testing.assert_allclose(jet.points[0], oracle(u[0, :, 0]), atol=1e-13)
    np.testing.assert_allclose(jet.first[0][0], oracle.derivative()(u[0, :, 0]), atol=1e-11)
    np.testing.assert_allclose(jet.second[0][0], oracle.derivative(2)(u[0, :, 0]), atol=1e-9)
    np.testing.assert_allclose(jet.points, shifted.points, atol=1e-11)


@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("degrees", [(2, 2), (3, 2), (3,)])
def test_numba_gives_the_bits_of_numpy_with_any_number_of_threads(degrees, second):
    pytest.importorskip("numba")
    rng = np.random.default_rng(8)
    knots = [np.concatenate([np.zeros(p), [0, 0.2, 0.45, 0.7, 1], np.ones(p)]) for p in degrees]
    shape = tuple(len(k) - p - 1 for k, p in zip(knots, degrees, strict=True))

    def one():
        control = rng.normal(size=(*shape, 3))
        return (
            BSplineCurve(degrees[0], knots[0], control)
            if len(degrees) == 1
            else BSplineSurface(degrees, *knots, control)
        )

    splines = [one() for _ in range(5)]
    parameters = rng.uniform(-0.3, 1.0, size=(5, 40, len(degrees)))
    parameters[..., 1:] = np.abs(parameters[..., 1:])
    parameters[:, 0] = 1.0
    periodic = (True, False)[: len(degrees)]
    jets = [
        SplineStack(splines, periodic, evaluator=name, threads=threads).evaluate(parameters, second=second)
        for name, threads in (("numpy", 1), ("numba", 1), ("numba", 3), ("numpy", 2))
    ]
    for jet in jets[1:]:
        for a, b in zip(
            (jets[0].points, *jets[0].first, *jets[0].second), (jet.points, *jet.first, *jet.second), strict=True
        ):
            assert a.tobytes() == b.tobytes()


def test_importing_the_engine_does_not_import_numba():
    import subprocess
    import sys

    code = "import sys, ssmpipe.core.correspondence.optimize, ssmpipe.stages.optimize; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
