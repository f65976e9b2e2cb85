import numpy as np
import pytest

from ssmpipe.core.optim.interior import DescentOptions, minimize_interior


class Quadratic:
    """``0.5 (x - c)' A (x - c) - mu sum log x``, feasible for x > 0."""

    def __init__(self, n=30, mu=0.0, seed=0):
        rng = np.random.default_rng(seed)
        q, _ = np.linalg.qr(rng.normal(size=(n, n)))
        self.a = q @ np.diag(np.geomspace(1, 1e4, n)) @ q.T
        self.c = rng.uniform(0.5, 2, n) if mu == 0 else rng.normal(size=n)
        self.mu = mu
        self.evaluated = []

    def value(self, x):
        return self.value_and_gradient(x)[0]

    def value_and_gradient(self, x):
        self.evaluated.append(x.min())
        r = self.a @ (x - self.c)
        value = 0.5 * (x - self.c) @ r
        if self.mu:
            return value - self.mu * np.log(x).sum(), r - self.mu / x
        return value, r

    def largest_step(self, x, direction):
        falling = direction < 0
        return float((x[falling] / -direction[falling]).min()) if falling.any() else np.inf

    def preconditioner(self, x):
        scale = np.diag(self.a) + self.mu / x**2
        return lambda g: g / scale

    def step_taken(self, x, direction):
        pass


def test_finds_the_minimum_of_an_ill_conditioned_quadratic():
    f = Quadratic()
    result = minimize_interior(
        f, np.ones(30), DescentOptions(max_iterations=500, relative_decrease=0, gradient_tolerance=1e-7)
    )
    assert result.status == "converged"
    np.testing.assert_allclose(result.value, f.c, atol=1e-5)


def test_never_evaluates_outside_and_solves_the_barrier_problem():
    f = Quadratic(mu=0.1)
    result = minimize_interior(
        f, np.ones(30), DescentOptions(max_iterations=500, relative_decrease=0, gradient_tolerance=1e-7)
    )
    assert min(f.evaluated) > 0
    assert np.abs(f.value_and_gradient(result.value)[1]).max() < 1e-2
    assert np.all(np.diff(result.history["value"]) <= 0)


def test_says_when_it_ran_out():
    assert minimize_interior(Quadratic(), np.ones(30), DescentOptions(max_iterations=2)).status == "out-of-iterations"


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_scipy(seed):
    from scipy.optimize import minimize

    f = Quadratic(mu=0.5, seed=seed)
    ours = minimize_interior(
        f, np.ones(30), DescentOptions(max_iterations=1000, relative_decrease=0, gradient_tolerance=1e-8)
    )
    theirs = minimize(
        lambda y: f.value_and_gradient(np.exp(y))[0],
        np.zeros(30),
        method="BFGS",
        options={"gtol": 1e-6, "maxiter": 5000},
    )
    assert ours.history["value"][-1] <= theirs.fun + 1e-6 * abs(theirs.fun)


class Curved(Quadratic):
    def hessian(self, x):
        return lambda v: self.a @ v + self.mu / x**2 * v


def test_newton_needs_few_steps_and_stays_feasible():
    f, g = Curved(mu=0.1), Quadratic(mu=0.1)
    options = DescentOptions(max_iterations=500, relative_decrease=0, gradient_tolerance=1e-7)
    newton = minimize_interior(f, np.ones(30), DescentOptions(**{**options.__dict__, "method": "newton"}))
    assert newton.status == "converged"
    assert newton.n_iterations < 50
    assert min(f.evaluated) > 0
    assert newton.history["value"][-1] <= minimize_interior(g, np.ones(30), options).history["value"][-1] + 1e-9


def test_newton_descends_where_the_curvature_is_negative():
    class Saddle(Curved):
        def value_and_gradient(self, x):
            return float((x**4 - x**2).sum()), 4 * x**3 - 2 * x

        def hessian(self, x):
            return lambda v: (12 * x**2 - 2) * v

        def preconditioner(self, x):
            return lambda g: g.copy()

        def step_taken(self, x, direction):
            pass

        def largest_step(self, x, direction):
            return np.inf

    result = minimize_interior(Saddle(), np.full(5, 0.05), DescentOptions(method="newton", relative_decrease=0))
    np.testing.assert_allclose(result.value, np.sqrt(0.5), atol=1e-6)
