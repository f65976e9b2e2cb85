import numpy as np
import pytest

from ssmpipe.core.spline.basis import design_matrix, gauss_rule
from ssmpipe.core.spline.knots import clamped_uniform_knots, greville


def cox_de_boor(u, knots, degree, k):
    """The recursion as in any textbook, slow and obvious."""
    if degree == 0:
        last = knots[k + 1] == knots[-1] and u == knots[-1]
        return float(knots[k] <= u < knots[k + 1] or (last and knots[k] < knots[k + 1]))
    out = 0.0
    if knots[k + degree] > knots[k]:
        out += (u - knots[k]) / (knots[k + degree] - knots[k]) * cox_de_boor(u, knots, degree - 1, k)
    if knots[k + degree + 1] > knots[k + 1]:
        out += (
            (knots[k + degree + 1] - u)
            / (knots[k + degree + 1] - knots[k + 1])
            * cox_de_boor(u, knots, degree - 1, k + 1)
        )
    return out


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_values_agree_with_the_recursion(degree):
    knots = clamped_uniform_knots(degree + 5, degree)
    u = np.linspace(0, 1, 23)
    slow = [[cox_de_boor(x, knots, degree, k) for k in range(degree + 5)] for x in u]
    np.testing.assert_allclose(design_matrix(u, knots, degree), slow, atol=1e-13)


@pytest.mark.parametrize("degree", [2, 3, 4])
@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_agree_with_differences(degree, order):
    knots = clamped_uniform_knots(degree + 5, degree)
    u = np.linspace(0.011, 0.987, 37)
    h = 1e-6
    lower = (design_matrix(u + h, knots, degree, order - 1) - design_matrix(u - h, knots, degree, order - 1)) / (2 * h)
    smooth = np.abs(u[:, None] - knots).min(axis=1) > 2 * h
    np.testing.assert_allclose(design_matrix(u, knots, degree, order)[smooth], lower[smooth], atol=2e-5)


def test_greville_coefficients_are_the_identity():
    knots = clamped_uniform_knots(9, 3)
    u = np.linspace(0, 1, 31)
    np.testing.assert_allclose(design_matrix(u, knots, 3) @ greville(knots, 3), u, atol=1e-14)


def test_gauss_rule_is_exact_to_its_degree_and_not_beyond():
    nodes, weights = gauss_rule(np.array([0, 0, 0.3, 1, 1.0]), 3)
    assert weights @ nodes**5 == pytest.approx(1 / 6, abs=1e-15)
    assert abs(weights @ nodes**6 - 1 / 7) > 1e-6
