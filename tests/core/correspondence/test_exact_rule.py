import numpy as np
import pytest

from ssmpipe.core.correspondence.direction import Direction
from ssmpipe.core.correspondence.exact_rule import ExactRule
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.sensitivity import direct_gradient
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.covariance.formulation_one import covariance_exact_reparameterized
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import gauss_rule
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.fit_curve import clamp_periodic
from ssmpipe.core.spline.knots import clamped_uniform_knots
from tests.support.cohorts import random_curves
from tests.support.surfaces import bumps, taylor_rate

N_COEFFICIENTS = 7


def closed_curves(degree, n_spans=9):
    rng = np.random.default_rng(degree)
    angle = 2 * np.pi * np.arange(n_spans) / n_spans
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return [clamp_periodic(circle * rng.uniform(0.7, 1.3, size=(n_spans, 1)), degree) for _ in range(4)]


def curves_for(boundary, degree):
    return (
        closed_curves(degree) if boundary == "periodic" else random_curves(np.random.default_rng(degree), 4, 9, degree)
    )


def objective(boundary, shape_degree=2, map_degree=2, reference=1, n_nodes=31, **options):
    curves = curves_for(boundary, shape_degree)
    space = Reparameterization((N_COEFFICIENTS,), (n_nodes,), degree=map_degree, boundary=boundary)
    rule = ExactRule(space.directions[0], curves[0].knots, shape_degree)
    function = spectral_function("description-length", 1e-3)
    stack = SplineStack(curves, space.periodic)
    return GroupObjective(stack, space, function, covariance="I", reference=reference, rule=rule, **options), curves


def inside(f, seed=0, size=0.015):
    return f.start() + f._keep_gauge(size * np.random.default_rng(seed).normal(size=f.start().size))


@pytest.mark.parametrize(("p", "d"), [(2, 2), (3, 2), (2, 3), (1, 2)])
def test_covariance_equals_the_composed_closed_form(p, d):
    f, curves = objective("fixed", p, d)
    x = inside(f)
    knots = clamped_uniform_knots(N_COEFFICIENTS, d)
    maps = [BSplineCurve(d, knots, c) for c in f.coefficients(x)]
    gram = f.evaluate(x).spectrum.gram
    expected = covariance_exact_reparameterized(curves, maps)
    np.testing.assert_allclose(gram, expected, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize(("p", "d"), [(2, 2), (3, 2), (2, 3)])
def test_covariance_of_closed_curves_equals_very_fine_quadrature(p, d):
    f, curves = objective("periodic", p, d)
    x = inside(f)
    b = f.coefficients(x)
    b[2] += 0.4  # the seam far from its place, on the other side of several knots
    b[3] -= 0.7
    exact = f.rule(b)
    gram = []
    for nodes, weights in (exact, gauss_rule(np.linspace(0, 1, 20001), 2)):
        points = SplineStack(curves, (True,)).evaluate(f.reparameterization.at((nodes,)).evaluate(b)).points
        centred = points - points.mean(axis=0)
        gram.append(np.einsum("ild,jld,l->ij", centred, centred, weights) / 3)
    np.testing.assert_allclose(gram[0], gram[1], atol=1e-11 * np.abs(gram[1]).max())


def test_spans_end_where_a_map_meets_a_knot():
    f, _ = objective("fixed")
    nodes, weights = f.rule(f.coefficients(inside(f)))
    n_ends_of_maps, n_inner_knots, n_shapes, n_per_span = 6, 6, 4, 5
    assert len(nodes) == (n_ends_of_maps + n_shapes * n_inner_knots - 1) * n_per_span
    assert weights.min() > 0
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)


def test_maps_that_meet_share_their_spans():
    rule = ExactRule(Direction(6, 2), clamped_uniform_knots(9, 2), 2)
    one = Direction(6, 2).identity[None, :, None]
    assert len(rule(np.repeat(one, 50, axis=0))[0]) == len(rule(one)[0])


@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
@pytest.mark.parametrize("reference", [1, -1])
@pytest.mark.parametrize(("p", "d"), [(2, 2), (3, 2), (2, 3), (1, 2)])
def test_gradient_through_the_moving_spans_is_exact(boundary, reference, p, d):
    f, _ = objective(boundary, p, d, reference, barrier=0.7, prior=0.2)
    x = inside(f)
    direction = f._keep_gauge(np.random.default_rng(7).normal(size=x.size))
    direction /= 10 * np.linalg.norm(direction)
    rate = taylor_rate(lambda y: f.value_and_gradient(y)[0], f.value_and_gradient(x)[1], x, direction)
    assert rate > 1.8


def test_one_gauss_point_fewer_spoils_value_and_gradient():
    """The integrand needs p d + 1 points on a single span; the law above is no accident of smooth data."""
    f, _ = objective("fixed")
    x = inside(f)
    value, gradient = f.spectral_gradient(x)
    f.rule._n_per_span = 4
    f._last = None
    fewer, other = f.spectral_gradient(x)
    f.rule._n_per_span = 9
    f._last = None
    more, same = f.spectral_gradient(x)
    assert abs(more - value) < 1e-12 * abs(value)
    np.testing.assert_allclose(same, gradient, atol=1e-11 * np.abs(gradient).max())
    assert abs(fewer - value) > 1e-11 * abs(value)
    assert np.abs(other - gradient).max() > 1e-9 * np.abs(gradient).max()


def test_direct_equals_adjoint_and_the_hessian_is_the_slope_of_the_gradient():
    f, _ = objective("periodic", 3, barrier=0.7)
    x = inside(f)
    adjoint = f.spectral_gradient(x)[1]
    np.testing.assert_allclose(direct_gradient(f, x), adjoint, atol=1e-9 * np.abs(adjoint).max())
    direction = np.random.default_rng(2).normal(size=x.size)
    product = f.hessian(x)(direction)
    forward, back = (f.value_and_gradient(x + h * direction)[1] for h in (1e-7, -1e-7))
    np.testing.assert_allclose(product, (forward - back) / 2e-7, atol=1e-6 * np.abs(product).max())


@pytest.mark.parametrize("solver", ["quasi-newton", "newton"])
def test_the_optimum_does_not_depend_on_a_number_of_landmarks(solver):
    curves = closed_curves(3)
    options = {"n_coefficients": (8,), "boundary": "periodic", "covariance": "I", "pose": "keep", "normalize": "none"}
    found = [
        optimize_correspondence(
            curves,
            EngineOptions(landmarks=(n,), quadrature=q, solver=solver, lambda_cut=1e-4, **options),  # type: ignore[arg-type]
        ).value
        for n, q in ((12, "closed-form"), (60, "closed-form"), (800, "midpoint"))
    ]
    np.testing.assert_array_equal(found[0].coefficients, found[1].coefficients)
    assert found[0].description_length[1] < found[0].description_length[0] - 0.2
    assert found[0].description_length[1] == pytest.approx(found[2].description_length[1], abs=2e-3)
    assert all(c.verdict == "proved" for c in found[0].certificates)


def test_what_has_no_closed_form_is_refused():
    with pytest.raises(GeometryError, match="no polynomial"):
        optimize_correspondence(
            bumps(3),
            EngineOptions(n_coefficients=(6, 6), landmarks=(21, 21), covariance="I", quadrature="closed-form"),
        )
    f, curves = objective("fixed")
    for changes in ({"covariance": "II"}, {"form": "sampled"}, {"target": np.zeros((31, 3))}):
        given = {"covariance": "I", "rule": f.rule, **changes}
        with pytest.raises(GeometryError, match="closed form is that of covariance I"):
            GroupObjective(SplineStack(curves), f.reparameterization, f.spectral, **given)
