from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ssmpipe.core.parameterize.remap import Remap, best_remap


@pytest.mark.parametrize("periodic", [False, True])
def test_even_energy_changes_nothing(periodic):
    v = (np.arange(1000) + 0.5) / 1000
    change = best_remap(v, np.ones(1000), 8, periodic)
    assert change(v) == pytest.approx(v, abs=1e-6)


def test_the_derivative_follows_the_cube_root_of_the_density():
    v = (np.arange(4000) + 0.5) / 4000
    wanted = 1.0 + v**2  # in the spline space
    change = best_remap(v, wanted**3, 6, False)
    assert change(v) == pytest.approx((v + v**3 / 3) / (4 / 3), abs=1e-4)


def test_no_other_coefficients_are_better():
    rng = np.random.default_rng(0)
    v = rng.uniform(size=300)
    energy = rng.uniform(size=300) * (1 + 20 * (v > 0.8))
    found = best_remap(v, energy, 7, True)

    def stretch(c):
        change, step = Remap(c, True), 1e-6
        slope = (change(v + step) - change(v - step)) / (2 * step)
        return (energy / slope**2).sum() / energy.sum()

    other = minimize(
        lambda log: stretch(np.exp(log)), np.zeros(7), method="BFGS", options={"gtol": 1e-8, "maxiter": 200}
    )
    assert stretch(found.coefficients) == pytest.approx(other.fun, rel=1e-3)


@pytest.mark.parametrize("periodic", [False, True])
def test_it_increases_and_keeps_the_ends(periodic):
    rng = np.random.default_rng(1)
    v = rng.uniform(size=200)
    # most of the interval empty: only the barrier decides there
    change = best_remap(v[v < 0.1], np.ones((v < 0.1).sum()), 12, periodic)
    t = np.linspace(0, 1, 1001)
    assert (np.diff(change(t)) > 0).all()
    assert change(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=1e-12)
    assert (np.diff(change.blended(0.5)(t)) > 0).all()
    assert change.blended(0.0)(t) == pytest.approx(t)
    if periodic:
        assert change(t + 3.0) == pytest.approx(change(t) + 3.0)
        slope = np.diff(change(np.array([-1e-6, 0.0, 1e-6])))
        assert slope[0] == pytest.approx(slope[1], rel=1e-3)
