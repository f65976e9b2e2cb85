import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import NdBSpline

from ssmpipe.core.correspondence.certificate import certify
from ssmpipe.core.correspondence.jacobian import BezierJacobian, bernstein_matrix, largest_feasible_step
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.basis import design_matrix


def dense_jacobian(coefficients, reparameterization, n=401):
    p = reparameterization.degree
    t = np.linspace(0, 1, n)
    value, slope = ([design_matrix(t, k, p, r) for k in reparameterization.knots] for r in (0, 1))
    c = np.moveaxis(coefficients, -1, 0)
    du, dv = slope[0] @ c @ value[1].T, value[0] @ c @ slope[1].T
    return du[0] * dv[1] - du[1] * dv[0]


@pytest.mark.parametrize("degree", [2, 3])
def test_bernstein_form_equals_dense_evaluation(degree):
    reparameterization = Reparameterization((degree + 4, degree + 3), (3, 3), degree=degree)
    rng = np.random.default_rng(0)
    b = reparameterization.identity() + 0.1 * rng.normal(size=reparameterization.identity().shape)
    jacobian = BezierJacobian(reparameterization.knots, degree)
    patches = jacobian.patches(jacobian.coefficients(b[None]))[0]
    t = np.linspace(0, 1, 11)
    basis = bernstein_matrix(t, jacobian.degree)
    spans_u, spans_v = patches.shape[:2]
    values = np.einsum("ka,stab,lb->sktl", basis, patches, basis)
    u = ((np.arange(spans_u)[:, None] + t * (1 - 1e-12)) / spans_u).ravel()
    v = ((np.arange(spans_v)[:, None] + t * (1 - 1e-12)) / spans_v).ravel()
    spline = NdBSpline(reparameterization.knots, b, (degree, degree))
    uv = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    du, dv = spline(uv, nu=(1, 0)), spline(uv, nu=(0, 1))
    det = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    np.testing.assert_allclose(values.reshape(len(u), len(v)), det, atol=1e-8)


def test_pull_back_and_rows_are_the_derivative():
    reparameterization = Reparameterization((6, 5), (3, 3))
    jacobian = BezierJacobian(reparameterization.knots, 2)
    rng = np.random.default_rng(1)
    b = reparameterization.identity()[None] + 0.05 * rng.normal(size=(2, 6, 5, 2))
    d = rng.normal(size=b.shape)
    j0 = jacobian.coefficients(b)
    first, second = jacobian.along(b, d, j0)
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


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.02, 0.25))
def test_certificate_agrees_with_dense_sampling_and_never_certifies_a_fold(seed, strength):
    reparameterization = Reparameterization((6, 6), (3, 3))
    rng = np.random.default_rng(seed)
    b = reparameterization.identity()
    b[reparameterization.free] += strength * rng.normal(size=int(reparameterization.free.sum()))
    certificate = certify(b, reparameterization)
    smallest = dense_jacobian(b, reparameterization, 201).min()
    assert certificate.lower_bound <= smallest + 1e-9
    if smallest <= 0:
        assert certificate.verdict != "proved"
    if certificate.verdict == "proved":
        assert certificate.lower_bound > 0
    if certificate.verdict == "refuted":
        assert dense_jacobian(b, reparameterization, 1601).min() < 1e-3


def test_maps_near_a_fold_are_decided():
    reparameterization = Reparameterization((6, 6), (3, 3))
    direction = np.zeros((6, 6, 2))
    direction[2, 2] = [1.0, 0.4]
    low, high = 0.0, 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if dense_jacobian(reparameterization.identity() + middle * direction, reparameterization).min() > 0:
            low = middle
        else:
            high = middle
    for share, verdict in ((0.98, "proved"), (1.05, "refuted")):
        certificate = certify(reparameterization.identity() + share * low * direction, reparameterization)
        assert certificate.verdict == verdict
