import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import NdBSpline

from ssmpipe.core.correspondence.certificate import certify
from ssmpipe.core.correspondence.jacobian import Jacobian, bernstein_matrix, largest_feasible_step
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.knots import clamped_uniform_knots


def dense_jacobian(coefficients, reparameterization, n=301):
    """Return ``det dD/du`` on an even grid, from the bases alone."""
    t = np.linspace(0, 1, n)
    value, slope = ([d.matrix(t, r) for d in reparameterization.directions] for r in (0, 1))
    c = np.moveaxis(coefficients - reparameterization.identity(), -1, 0)
    if len(value) == 1:
        return 1 + slope[0] @ c[0]
    du, dv = slope[0] @ c @ value[1].T, value[0] @ c @ slope[1].T
    return (1 + du[0]) * (1 + dv[1]) - du[1] * dv[0]


@pytest.mark.parametrize("degree", [2, 3])
def test_bernstein_form_equals_dense_evaluation(degree):
    reparameterization = Reparameterization((degree + 4, degree + 3), (3, 3), degree=degree)
    rng = np.random.default_rng(0)
    b = reparameterization.identity() + 0.1 * rng.normal(size=reparameterization.identity().shape)
    jacobian = Jacobian(reparameterization)
    spans_u, spans_v = jacobian.n_spans
    m = jacobian.degree + 1
    patches = jacobian.patches(jacobian.coefficients(b[None]))[0].reshape(spans_u, spans_v, m, m)
    t = np.linspace(0, 1, 11)
    basis = bernstein_matrix(t, jacobian.degree)
    values = np.einsum("ka,stab,lb->sktl", basis, patches, basis)
    u = ((np.arange(spans_u)[:, None] + t * (1 - 1e-12)) / spans_u).ravel()
    v = ((np.arange(spans_v)[:, None] + t * (1 - 1e-12)) / spans_v).ravel()
    knots = tuple(clamped_uniform_knots(n, degree) for n in reparameterization.n_coefficients)
    spline = NdBSpline(knots, b, (degree, degree))
    uv = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    du, dv = spline(uv, nu=(1, 0)), spline(uv, nu=(0, 1))
    det = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    np.testing.assert_allclose(values.reshape(len(u), len(v)), det, atol=1e-8)


SPACES = [
    ((6, 5), "fixed", 2),
    ((6, 5), "sliding", 3),
    ((6, 5), "periodic", 2),
    ((7,), "fixed", 2),
    ((7,), "periodic", 3),
]


@pytest.mark.parametrize(("n", "boundary", "degree"), SPACES)
@pytest.mark.parametrize("form", ["bezier", "bspline", "sampled"])
def test_pull_back_and_rows_are_the_derivative(n, boundary, degree, form):
    if form == "bspline" and boundary == "periodic":
        pytest.skip("the B-spline form is for fixed and sliding boundaries")
    reparameterization = Reparameterization(n, (9,) * len(n), boundary=boundary, degree=degree)
    jacobian = Jacobian(reparameterization, form)
    rng = np.random.default_rng(1)
    identity = reparameterization.identity()
    b = identity[None] + 0.05 * rng.normal(size=(2, *identity.shape))
    d = rng.normal(size=b.shape)
    j0 = jacobian.coefficients(b)
    first, second = jacobian.at(b).along(d)
    np.testing.assert_allclose(jacobian.coefficients(b + 0.37 * d), j0 + 0.37 * first + 0.37**2 * second, atol=1e-9)
    w = rng.normal(size=j0.shape)
    assert (w * first).sum() == pytest.approx((jacobian.pull_back(b, w) * d).sum(), rel=1e-10)
    np.testing.assert_allclose(jacobian.rows(b[1]) @ d[1].ravel(), first[1], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_largest_step_is_where_the_first_coefficient_reaches_zero(seed):
    rng = np.random.default_rng(seed)
    c, b, a = rng.uniform(0.1, 2, 30), rng.normal(size=30), rng.normal(size=30)
    step = largest_feasible_step(c, b, a)
    if np.isinf(step):
        t = np.linspace(0, 100, 20001)[:, None]
        assert ((c + t * b + t * t * a) > 0).all()
    else:
        t = np.linspace(0, step * (1 - 1e-9), 5001)[:, None]
        assert ((c + t * b + t * t * a) > 0).all()
        assert abs((c + step * b + step**2 * a).min()) < 1e-9 * max(1.0, step**2)


MAPS = [
    *[((6, 6), boundary, degree) for boundary in ("fixed", "sliding", "periodic") for degree in (2, 3)],
    *[((7,), boundary, degree) for boundary in ("fixed", "periodic") for degree in (2, 3, 4)],
]
"""On a curve ``sliding`` is ``fixed``."""


def random_direction(reparameterization, seed):
    rng = np.random.default_rng(seed)
    direction = np.zeros(reparameterization.identity().shape)
    direction[reparameterization.free] = rng.normal(size=int(reparameterization.free.sum()))
    return direction


def fold_at(reparameterization, direction, n=301):
    """Return the factor of ``direction`` at which the densely sampled Jacobian, a quadratic in the factor, first reaches zero."""
    identity = reparameterization.identity()
    ahead, behind = (dense_jacobian(identity + sign * direction, reparameterization, n).ravel() for sign in (1, -1))
    linear, square = 0.5 * (ahead - behind), 0.5 * (ahead + behind) - 1.0
    root = np.sqrt(np.maximum(linear**2 - 4 * square, 0.0))
    real = (linear**2 >= 4 * square) & (root > linear)
    return float((2.0 / (root - linear)[real]).min())


@pytest.mark.parametrize(("n", "boundary", "degree"), MAPS)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.one_of(st.floats(0.2, 1.5), st.floats(0.98, 1.02), st.just(1.0)))
def test_certificate_agrees_with_dense_sampling_and_never_certifies_a_fold(n, boundary, degree, seed, share):
    """Random maps on the way to a fold, at it and beyond; many shares lie within 2 % of it."""
    reparameterization = Reparameterization(n, (3,) * len(n), boundary=boundary, degree=degree)
    direction = random_direction(reparameterization, seed)
    b = reparameterization.identity() + share * fold_at(reparameterization, direction) * direction
    certificate = certify(b, reparameterization)
    smallest = dense_jacobian(b, reparameterization).min()
    assert certificate.lower_bound <= smallest
    assert certificate.upper_bound_of_minimum >= certificate.lower_bound
    if smallest <= 0:
        assert certificate.verdict != "proved"
    if certificate.verdict == "proved":
        assert certificate.lower_bound > 0
    if certificate.verdict == "refuted":
        finer = dense_jacobian(b, reparameterization, 901 if len(n) == 2 else 20001)
        assert finer.min() < 2e-3 * max(1.0, np.abs(finer).max())
    if share < 0.97:
        assert certificate.verdict == "proved"
    if share > 1.03:
        assert certificate.verdict == "refuted"


@pytest.mark.parametrize(("n", "boundary", "degree"), MAPS)
def test_maps_near_a_fold_are_decided(n, boundary, degree):
    reparameterization = Reparameterization(n, (3,) * len(n), boundary=boundary, degree=degree)
    for seed in range(3):
        direction = random_direction(reparameterization, seed)
        low = fold_at(reparameterization, direction)
        for share, verdict in ((0.98, "proved"), (1.02, "refuted")):
            certificate = certify(reparameterization.identity() + share * low * direction, reparameterization)
            assert certificate.verdict == verdict


@pytest.mark.parametrize(("n", "boundary", "degree"), SPACES)
def test_forms_bound_or_sample_the_same_polynomial(n, boundary, degree):
    reparameterization = Reparameterization(n, (40,) * len(n), boundary=boundary, degree=degree)
    identity = reparameterization.identity()
    b = identity + 0.02 * np.random.default_rng(3).normal(size=identity.shape)
    sampled = Jacobian(reparameterization, "sampled").coefficients(b[None]).min()
    bezier = Jacobian(reparameterization).coefficients(b[None]).min()
    assert bezier <= sampled + 1e-12
    if boundary != "periodic":
        bspline = Jacobian(reparameterization, "bspline").coefficients(b[None]).min()
        assert bspline <= bezier + 1e-9


def test_periodic_maps_turn_and_are_certified():
    reparameterization = Reparameterization((6, 5), (12, 7), boundary="periodic")
    b = reparameterization.identity()
    b[..., 0] += 0.3
    u = reparameterization.evaluate(b[None]).reshape(12, 7, 2)
    np.testing.assert_allclose(u[..., 0], np.arange(12)[:, None] / 12 + 0.3 + np.zeros((1, 7)), atol=1e-12)
    np.testing.assert_allclose(u[0, :, 1], np.linspace(0, 1, 7), atol=1e-12)
    assert certify(b, reparameterization).verdict == "proved"
    assert certify(b, reparameterization).lower_bound == pytest.approx(1.0, abs=1e-9)


def test_curve_certificate_proves_and_refutes():
    reparameterization = Reparameterization((8,), (11,))
    b = reparameterization.identity()
    assert certify(b, reparameterization).verdict == "proved"
    b[4] = b[2] - 0.01
    assert certify(b, reparameterization).verdict == "refuted"
