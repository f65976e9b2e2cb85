import numpy as np
import pytest

from ssmpipe.core.covariance.quadrature import (
    gauss,
    gauss_points_for_exact,
    gauss_refined,
    midpoints,
    tensor,
    uniform,
)
from ssmpipe.core.errors import GeometryError
from tests.support.cohorts import random_map, slope


def error(rule, function, exact):
    nodes, weights = rule
    return abs(weights @ function(nodes) - exact)


def test_all_rules_integrate_constants_and_lines():
    for nodes, weights in (uniform(7), midpoints(7), gauss(np.array([0, 0.3, 1]), 2)):
        assert weights.sum() == pytest.approx(1, abs=1e-15)
        assert weights @ nodes == pytest.approx(0.5, abs=1e-15)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_gauss_is_exact_to_its_degree_and_no_further(n):
    rule = gauss(np.array([0, 0.3, 0.4, 1]), n)
    for degree in range(2 * n):
        assert error(rule, lambda u, k=degree: u**k, 1 / (degree + 1)) < 1e-15
    assert error(rule, lambda u: u ** (2 * n), 1 / (2 * n + 1)) > 1e-7


def test_orders_of_convergence():
    counts = [10, 20, 40, 80, 160]
    exact = np.e - 1
    assert slope(counts, [error(midpoints(n), np.exp, exact) for n in counts]) == pytest.approx(2, abs=0.02)
    assert slope(counts, [error(uniform(n), lambda u: u**2, 1 / 3) for n in counts]) == pytest.approx(1, abs=0.1)
    spans = [2, 4, 8, 16]
    errors = [error(gauss(np.linspace(0, 1, m + 1), 2), np.exp, exact) for m in spans]
    assert slope(spans, errors) == pytest.approx(4, abs=0.05)


def test_refined_spans_hold_whole_polynomials():
    rng = np.random.default_rng(0)
    maps = [random_map(rng, 6, 2) for _ in range(3)]
    knots = np.array([0, 0, 0.5, 1, 1])
    nodes, weights = gauss_refined(knots, maps, 4)
    # 3 inner knots of each map and one inverse image each
    assert len(nodes) == 4 * (3 * 3 + 3 + 1)
    assert weights.sum() == pytest.approx(1, abs=1e-14)
    assert np.all(np.diff(nodes) > 0)


def test_tensor_order_is_that_of_a_raveled_grid():
    rule = tensor(midpoints(3), gauss(np.array([0, 1.0]), 2))
    grid = rule.parameters.reshape(3, 2, 2)
    assert np.all(np.diff(grid[:, 0, 0]) > 0)
    assert np.all(np.diff(grid[0, :, 1]) > 0)
    assert rule.weights @ (rule.parameters[:, 0] * rule.parameters[:, 1] ** 3) == pytest.approx(1 / 8)
    assert tensor(midpoints(3)).parameters.shape == (3, 1)


def test_table_of_exact_counts():
    assert gauss_points_for_exact(2) == 3
    assert gauss_points_for_exact(3, 2) == 7
    assert gauss_points_for_exact((2, 3)) == (3, 4)
    assert gauss_points_for_exact((2, 3), (1, 2)) == (6, 11)
    with pytest.raises(GeometryError, match="number of directions"):
        gauss_points_for_exact((2, 3), (2,))
    with pytest.raises(GeometryError, match="at least 1 node"):
        midpoints(0)
