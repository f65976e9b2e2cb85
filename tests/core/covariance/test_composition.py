import numpy as np
import pytest
from scipy.interpolate import BPoly, BSpline

from ssmpipe.core.covariance.composition import (
    bernstein_compose,
    bernstein_product,
    bezier_pieces,
    check_reparameterization,
    compose_curve,
    inverse_parameters,
    refined_breakpoints,
)
from ssmpipe.core.errors import FoldoverError, GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import clamped_uniform_knots
from tests.support.cohorts import random_curves, random_map

DENSE = np.linspace(0, 1, 1001)


def evaluate(curve: BSplineCurve, u):
    return BSpline(curve.knots, curve.control_points, curve.degree)(u)


def bernstein(coefficients, t):
    return BPoly(np.asarray(coefficients)[:, None], [0, 1])(t)


@pytest.mark.parametrize(("p", "q"), [(0, 3), (1, 1), (2, 3), (5, 4)])
def test_product_is_the_product_of_the_values(p, q):
    rng = np.random.default_rng(p + 10 * q)
    a, b = rng.normal(size=p + 1), rng.normal(size=q + 1)
    product = bernstein_product(a, b)
    assert product.shape == (p + q + 1,)
    np.testing.assert_allclose(bernstein(product, DENSE), bernstein(a, DENSE) * bernstein(b, DENSE), atol=1e-14)


def test_products_broadcast_over_leading_axes():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(4, 1, 3)), rng.normal(size=(1, 5, 2))
    product = bernstein_product(a, b)
    assert product.shape == (4, 5, 4)
    np.testing.assert_allclose(product[2, 3], bernstein_product(a[2, 0], b[0, 3]), atol=1e-15)


@pytest.mark.parametrize(("p", "q"), [(1, 3), (2, 2), (3, 3), (4, 1)])
def test_composition_of_polynomials_is_the_composition_of_the_values(p, q):
    rng = np.random.default_rng(p + 10 * q)
    outer, inner = rng.normal(size=(p + 1, 2)), np.sort(rng.uniform(size=q + 1))
    composed = bernstein_compose(outer, inner)
    assert composed.shape == (p * q + 1, 2)
    np.testing.assert_allclose(
        bernstein(composed[:, 1], DENSE), bernstein(outer[:, 1], bernstein(inner, DENSE)), atol=2e-14
    )


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_pieces_are_the_spline_on_its_spans(degree):
    rng = np.random.default_rng(degree)
    curve = random_curves(rng, 1, degree + 5, degree)[0]
    ends = np.unique(np.concatenate([curve.knots, rng.uniform(size=6)]))
    pieces = bezier_pieces(curve.knots, degree, curve.control_points, ends)
    t = np.linspace(0, 1, 11)
    for k in range(len(ends) - 1):
        u = ends[k] + t * (ends[k + 1] - ends[k])
        np.testing.assert_allclose(bernstein(pieces[k, :, 2], t), evaluate(curve, u)[:, 2], atol=1e-13)


def test_pieces_of_a_spline_with_repeated_knots():
    knots = np.array([0, 0, 0, 0.25, 0.5, 0.5, 1, 1, 1])
    control = np.random.default_rng(0).normal(size=(6, 1))
    pieces = bezier_pieces(knots, 2, control, np.unique(knots))
    np.testing.assert_allclose(bernstein(pieces[2, :, 0], 0.3), BSpline(knots, control, 2)(0.65)[0], atol=1e-14)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_inverse_parameters_undo_the_map(degree):
    mapping = random_map(np.random.default_rng(degree), degree + 6, degree)
    values = np.linspace(0, 1, 101)
    psi = inverse_parameters(mapping, values)
    np.testing.assert_allclose(evaluate(mapping, psi)[:, 0], values, atol=4e-16)
    assert psi[0] == 0
    assert psi[-1] == 1
    assert np.all(np.diff(psi) > 0)


@pytest.mark.parametrize(("p", "d"), [(1, 2), (2, 2), (3, 2), (2, 3), (3, 3)])
def test_composed_curve_is_exact(p, d):
    rng = np.random.default_rng(p + 10 * d)
    curve, mapping = random_curves(rng, 1, p + 6, p)[0], random_map(rng, d + 5, d)
    composed = compose_curve(curve, mapping)
    assert composed.degree == p * d
    np.testing.assert_allclose(evaluate(composed, DENSE), evaluate(curve, evaluate(mapping, DENSE)[:, 0]), atol=1e-13)


def test_the_knots_of_shape_and_map_alone_do_not_suffice():
    # fails if the inverse images are left out of the refinement
    rng = np.random.default_rng(5)
    curve, mapping = random_curves(rng, 1, 7, 2)[0], random_map(rng, 5, 2)
    ends = refined_breakpoints(curve.knots, [mapping])
    images = evaluate(mapping, ends)[:, 0]
    for knot in np.unique(curve.knots):
        assert np.abs(images - knot).min() < 1e-15
    assert np.isin(np.unique(mapping.knots), ends).all()
    assert len(ends) == 5 + 3 - 2 + 2


def test_identity_composes_to_the_curve_on_its_own_knots():
    curve = random_curves(np.random.default_rng(2), 1, 8, 3)[0]
    identity = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0.0], [1.0]]))
    composed = compose_curve(curve, identity)
    np.testing.assert_allclose(np.unique(composed.knots), np.unique(curve.knots), atol=1e-15)
    np.testing.assert_allclose(evaluate(composed, DENSE), evaluate(curve, DENSE), atol=1e-14)


def test_bad_maps_are_refused_with_numbers():
    knots = clamped_uniform_knots(5, 2)
    fold = BSplineCurve(2, knots, np.array([[0.0], [0.5], [0.4], [0.8], [1.0]]))
    with pytest.raises(FoldoverError, match="decreases between"):
        check_reparameterization(fold)
    short = BSplineCurve(2, knots, np.linspace(0, 0.9, 5)[:, None])
    with pytest.raises(GeometryError, match=r"\[0, 0.9\]"):
        inverse_parameters(short, np.array([0.5]))
    with pytest.raises(GeometryError, match="dimension 1, got 2"):
        compose_curve(short, BSplineCurve(2, knots, np.zeros((5, 2))))
