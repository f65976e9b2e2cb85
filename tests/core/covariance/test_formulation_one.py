import numpy as np
import pytest

from ssmpipe.core.covariance.composition import compose_curve
from ssmpipe.core.covariance.formulation_one import (
    basis_gram,
    bernstein_gram,
    covariance_exact,
    covariance_exact_reparameterized,
    covariance_gauss,
    covariance_midpoint,
    weighted_covariance,
)
from ssmpipe.core.covariance.quadrature import gauss_points_for_exact
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix, gauss_rule
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.surface import BSplineSurface
from tests.support.cohorts import (
    line_bumps,
    plane_bumps,
    random_curves,
    random_map,
    random_square_map,
    random_surfaces,
    slope,
)


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


# -- closed form -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 3, 6])
def test_inner_products_of_the_basis_agree_with_quadrature(degree):
    rng = np.random.default_rng(degree)
    knots = np.concatenate([np.zeros(degree + 1), np.sort(rng.uniform(size=4)), np.ones(degree + 1)])
    nodes, weights = gauss_rule(knots, degree + 1)
    values = design_matrix(nodes, knots, degree)
    np.testing.assert_allclose(basis_gram(knots, degree), values.T @ (weights[:, None] * values), atol=1e-15)


def test_bernstein_inner_products_by_hand():
    np.testing.assert_allclose(bernstein_gram(2) * 30, [[6, 3, 1], [3, 4, 3], [1, 3, 6]], atol=1e-14)


def test_printed_bezier_formula():
    """The double sum [3.6] written out, independent of matrices and pieces."""
    from math import comb

    curves = random_curves(np.random.default_rng(3), 3, 4, 3)
    p, control = 3, np.stack([c.control_points for c in curves])
    hat = control - control.mean(axis=0)
    printed = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for j in range(2 * p + 1):
                for k in range(max(0, j - p), min(j, p) + 1):
                    factor = comb(p, k) * comb(p, j - k) / (comb(2 * p, j) * 2 * (2 * p + 1))
                    printed[a, b] += factor * (hat[a, k] @ hat[b, j - k])
    np.testing.assert_allclose(covariance_exact(curves), printed, atol=1e-14)


def test_covariance_is_symmetric_semidefinite_and_centred():
    c = covariance_exact(plane_bumps())
    np.testing.assert_allclose(c, c.T, atol=1e-14)
    np.testing.assert_allclose(c.sum(axis=0), 0, atol=1e-13)
    assert np.linalg.eigvalsh(c).min() > -1e-13


# -- exact counts of Gauss points (table 3.2) --------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "n_control"), [(1, 2), (2, 3), (3, 4), (2, 9), (3, 8)])
def test_curves_need_one_point_more_than_their_degree(degree, n_control):
    curves = random_curves(np.random.default_rng(degree), 4, n_control, degree)
    exact = covariance_exact(curves)
    n = gauss_points_for_exact(degree)
    assert relative(covariance_gauss(curves), exact) < 1e-14
    assert relative(covariance_gauss(curves, n_per_span=(n,)), exact) < 1e-14
    assert relative(covariance_gauss(curves, n_per_span=(n - 1,)), exact) > 1e-4


@pytest.mark.parametrize(("degree", "n_control"), [((2, 3), (3, 4)), ((2, 2), (7, 6)), ((1, 3), (5, 6))])
def test_surfaces_need_one_point_more_than_their_degree(degree, n_control):
    surfaces = random_surfaces(np.random.default_rng(sum(degree)), 3, n_control, degree)
    exact = covariance_exact(surfaces)
    p, q = gauss_points_for_exact(degree)
    assert relative(covariance_gauss(surfaces, n_per_span=(p, q)), exact) < 1e-14
    assert relative(covariance_gauss(surfaces, n_per_span=(p - 1, q)), exact) > 1e-4
    assert relative(covariance_gauss(surfaces, n_per_span=(p, q - 1)), exact) > 1e-4


@pytest.mark.parametrize(("p", "d", "n_control"), [(2, 2, 3), (2, 2, 7), (3, 2, 6), (2, 3, 6)])
def test_reparameterized_curves_are_exact_on_refined_spans(p, d, n_control):
    rng = np.random.default_rng(p + 10 * d + 100 * n_control)
    curves = random_curves(rng, 3, n_control, p)
    knots = clamped_uniform_knots(d + 3, d)
    maps = [_on_knots(random_map(rng, d + 3, d), knots) for _ in curves]
    exact = covariance_exact_reparameterized(curves, maps)
    n = gauss_points_for_exact(p, d)
    assert relative(covariance_gauss(curves, maps), exact) < 1e-14
    assert relative(covariance_gauss(curves, maps, n_per_span=(n - 1,)), exact) > 1e-12


def test_one_point_fewer_than_p_d_plus_one_is_inexact_beyond_doubt():
    """On one span, where the missing point weighs most."""
    rng = np.random.default_rng(9)
    curves = random_curves(rng, 3, 3, 2)
    maps = [random_map(rng, 3, 2) for _ in curves]
    exact = covariance_exact_reparameterized(curves, maps)
    assert relative(covariance_gauss(curves, maps, n_per_span=(5,)), exact) < 1e-14
    assert relative(covariance_gauss(curves, maps, n_per_span=(4,)), exact) > 1e-7


def test_a_common_map_gives_the_covariance_of_the_composed_curves():
    rng = np.random.default_rng(4)
    curves, mapping = random_curves(rng, 4, 8, 2), random_map(rng, 6, 2)
    composed = [compose_curve(c, mapping) for c in curves]
    assert relative(covariance_exact_reparameterized(curves, [mapping] * 4), covariance_exact(composed)) < 1e-13


def test_reparameterized_patches_need_the_sum_of_both_degrees():
    """Both components of D depend on both parameters: ``p d + 1``, as printed in table 3.2, is too few."""
    rng = np.random.default_rng(6)
    patches = random_surfaces(rng, 3, (3, 3), (2, 2))
    maps = [random_square_map(rng, 5, 2, size=0.1) for _ in patches]
    many = covariance_gauss(patches, maps, n_per_span=(20, 20))
    n = gauss_points_for_exact((2, 2), (2, 2))
    assert n == (9, 9)
    assert relative(covariance_gauss(patches, maps, n_per_span=n), many) < 1e-13
    assert relative(covariance_gauss(patches, maps, n_per_span=(5, 5)), many) > 1e-11


def test_printed_count_suffices_where_each_component_keeps_to_its_own_parameter():
    rng = np.random.default_rng(8)
    patches = random_surfaces(rng, 3, (3, 3), (2, 2))
    knots = clamped_uniform_knots(5, 2)
    maps = []
    for _ in patches:
        u, v = (_on_knots(random_map(rng, 5, 2), knots).control_points[:, 0] for _ in range(2))
        maps.append(BSplineSurface((2, 2), knots, knots, np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)))
    many = covariance_gauss(patches, maps, n_per_span=(20, 20))
    assert relative(covariance_gauss(patches, maps, n_per_span=(5, 5)), many) < 1e-14
    assert relative(covariance_gauss(patches, maps, n_per_span=(4, 4)), many) > 1e-9


def test_reparameterized_spline_surfaces_are_not_exact():
    rng = np.random.default_rng(7)
    surfaces = random_surfaces(rng, 3, (6, 6), (2, 2))
    maps = [random_square_map(rng, 5, 2) for _ in surfaces]
    assert relative(covariance_gauss(surfaces, maps), covariance_midpoint(surfaces, (300, 300), maps)) < 1e-4
    assert relative(covariance_gauss(surfaces, maps), covariance_gauss(surfaces, maps, n_per_span=(30, 30))) > 1e-9


# -- convergence of the mid-point rule (figures 3.6, 3.10, 3.11) -------------------------------------------------------


def norm_and_first_eigenvalue(c):
    return np.array([np.linalg.norm(c), np.linalg.eigvalsh(c)[-1]])


@pytest.mark.parametrize(("cohort", "counts"), [(line_bumps, [80, 160, 320, 640]), (plane_bumps, [36, 72, 144])])
@pytest.mark.parametrize(("tilt", "order"), [(0.3, 2), (0.0, 4)])
def test_midpoints_converge_with_order_two_or_four_where_the_ends_agree(cohort, counts, tilt, order):
    """The h^2 term of the mid-point rule is the jump of the integrand's slope at the ends; bumps away from them have none."""
    shapes = cohort(tilt=tilt)
    exact = norm_and_first_eigenvalue(covariance_exact(shapes))
    rules = [(n,) * len(shapes[0].degrees) for n in counts]
    errors = [np.abs(norm_and_first_eigenvalue(covariance_midpoint(shapes, n)) - exact) for n in rules]
    for column in np.transpose(errors):
        assert slope(counts, column) == pytest.approx(order, abs=0.02 if order == 2 else 0.25)


def test_midpoints_on_reparameterized_line_bumps_converge_with_order_two():
    """The kinks lie anywhere between the points, so single errors scatter; their root mean square over eight counts does not."""
    curves = line_bumps(tilt=0.3)
    maps = [random_map(np.random.default_rng(0), 5, 2)] * len(curves)
    exact = norm_and_first_eigenvalue(covariance_exact_reparameterized(curves, maps))
    counts = [40, 80, 160, 320, 640]
    errors = [
        np.square([norm_and_first_eigenvalue(covariance_midpoint(curves, (n + k,), maps)) - exact for k in range(8)])
        for n in counts
    ]
    for column in np.sqrt(np.mean(errors, axis=1)).T:
        assert slope(counts, column) == pytest.approx(2, abs=0.15)


def test_formulation_one_depends_on_a_common_reparameterization():
    curves, mapping = line_bumps(), random_map(np.random.default_rng(1), 5, 2)
    assert relative(covariance_exact_reparameterized(curves, [mapping] * 4), covariance_exact(curves)) > 0.05


# -- errors ------------------------------------------------------------------------------------------------------------


def test_unusable_cohorts_are_refused():
    curves = line_bumps()
    with pytest.raises(GeometryError, match="at least two shapes, got 1"):
        covariance_exact(curves[:1])
    with pytest.raises(GeometryError, match="at least two shapes"):
        weighted_covariance(np.zeros((1, 2, 3)), np.ones(2))
    with pytest.raises(GeometryError, match="other knots"):
        covariance_exact([curves[0], line_bumps(n_control=9)[0]])
    with pytest.raises(GeometryError, match="2 reparameterizations for 4 curves"):
        covariance_exact_reparameterized(curves, [random_map(np.random.default_rng(0), 5, 2)] * 2)


def _on_knots(mapping, knots):
    return BSplineCurve(mapping.degree, knots, mapping.control_points)
