import numpy as np
import pytest

from ssmpipe.core.correspondence.barrier import Barrier

J = np.random.default_rng(0).uniform(0.2, 2.0, size=(3, 7))
CHANGE = np.random.default_rng(1).normal(size=J.shape)


@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_its_own_multipliers_are_those_of_its_slope(aggregate):
    barrier = Barrier(aggregate, 0.1, 25.0)
    h = 1e-6
    value = (barrier.value(J + h * CHANGE) - barrier.value(J - h * CHANGE)) / (2 * h)
    assert (barrier.slope(J) * CHANGE).sum() == pytest.approx(value, rel=1e-8)
    slope = (barrier.slope(J + h * CHANGE) - barrier.slope(J - h * CHANGE)) / (2 * h)
    np.testing.assert_allclose(barrier.slope_along(J, CHANGE, barrier.multipliers(J)), slope, rtol=1e-6, atol=1e-8)


def test_a_full_step_keeps_linearized_complementarity():
    barrier, weight = Barrier(), 0.3
    z = weight * barrier.multipliers(J) * np.random.default_rng(2).uniform(0.5, 1.5, J.shape)
    change = 1e-2 * CHANGE
    new = barrier.followed(J, change, z, weight)
    np.testing.assert_allclose(z * J + z * change + (new - z) * J, weight / 7, rtol=1e-12)


@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_multipliers_stay_on_the_central_path_and_positive_off_it(aggregate):
    barrier = Barrier(aggregate, 0.1, 25.0)
    central = 0.3 * barrier.multipliers(J)
    np.testing.assert_allclose(barrier.followed(J, 0.0 * J, central, 0.3), central, rtol=1e-13)
    far = barrier.followed(J, 100 * CHANGE, central, 0.3)
    assert (far > 0).all()
    assert (far / central).min() == pytest.approx(0.005)
