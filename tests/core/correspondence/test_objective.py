import numpy as np
import pytest

from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.spline.evaluate import SplineStack
from tests.support.surfaces import bumps, taylor_rate


def objective(covariance="discrete", boundary="fixed", reference=1, **options):
    reparameterization = Reparameterization((7, 6), (21, 23), boundary=boundary)
    stack = SplineStack(bumps(5))
    return GroupObjective(
        stack, reparameterization, lambda_cut=1e-3, covariance=covariance, reference=reference, **options
    )


@pytest.mark.parametrize("covariance", ["discrete", "II"])
@pytest.mark.parametrize("boundary", ["fixed", "sliding"])
@pytest.mark.parametrize("reference", [1, -1])
@pytest.mark.parametrize("terms", [{"prior": 0, "barrier": 0}, {"prior": 0.3, "barrier": 0.7, "floor": 0.05}])
def test_gradient_is_exact(covariance, boundary, reference, terms):
    f = objective(covariance, boundary, reference, **terms)
    rng = np.random.default_rng(0)
    x = f.start() + 0.01 * rng.normal(size=f.start().size)
    direction = rng.normal(size=x.size)
    direction /= np.linalg.norm(direction) * 10
    rate = taylor_rate(lambda y: f.value_and_gradient(y)[0], f.value_and_gradient(x)[1], x, direction)
    assert rate > 1.8


def test_a_gradient_wrong_by_a_thousandth_is_seen():
    f = objective()
    rng = np.random.default_rng(0)
    x = f.start() + 0.01 * rng.normal(size=f.start().size)
    direction = rng.normal(size=x.size)
    direction /= np.linalg.norm(direction) * 10
    assert taylor_rate(lambda y: f.value_and_gradient(y)[0], 1.001 * f.value_and_gradient(x)[1], x, direction) < 1.5


def test_pull_back_is_the_transpose_of_evaluate():
    reparameterization = Reparameterization((7, 6), (11, 9))
    rng = np.random.default_rng(2)
    b, w = 0.5 + 0.1 * rng.normal(size=(3, 7, 6, 2)), rng.normal(size=(3, 99, 2))
    moved = reparameterization.evaluate(np.clip(b, 0, 1))
    base = reparameterization.evaluate(np.full_like(b, 0.5))
    left = ((moved - base) * w).sum()
    right = ((np.clip(b, 0, 1) - 0.5) * reparameterization.pull_back(w)).sum()
    assert left == pytest.approx(right, rel=1e-12)


def test_description_length_does_not_depend_on_the_order_of_the_shapes():
    surfaces = bumps(5)
    reparameterization = Reparameterization((6, 6), (21, 21))
    order = [3, 0, 4, 1, 2]
    a = GroupObjective(SplineStack(surfaces), reparameterization, lambda_cut=1e-3)
    b = GroupObjective(SplineStack([surfaces[i] for i in order]), reparameterization, lambda_cut=1e-3)
    assert a.description_length(a.start()) == pytest.approx(b.description_length(b.start()), rel=1e-10)


def test_preconditioner_is_symmetric_and_positive():
    f = objective(prior=0.1, barrier=1.0)
    x = f.start() + 0.005 * np.random.default_rng(1).normal(size=f.start().size)
    apply = f.preconditioner(x)
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, x.size))
    assert a @ apply(b) == pytest.approx(b @ apply(a), rel=1e-8)
    assert a @ apply(a) > 0


def test_gauss_newton_block_matches_its_definition():
    reparameterization = Reparameterization((5, 6), (7, 8))
    rng = np.random.default_rng(5)
    metric = rng.normal(size=(56, 3))
    dense = reparameterization.normal_blocks(metric)
    unit = np.eye(5 * 6 * 2).reshape(-1, 5, 6, 2)
    values = np.stack([(reparameterization.evaluate(0.25 + 0.5 * e[None]) - 0.25)[0] / 0.5 for e in unit])
    full = np.empty((56, 2, 2))
    full[:, 0, 0], full[:, 0, 1], full[:, 1, 0], full[:, 1, 1] = metric[:, 0], metric[:, 1], metric[:, 1], metric[:, 2]
    np.testing.assert_allclose(dense, np.einsum("alc,lcd,bld->ab", values, full, values), atol=1e-10)
