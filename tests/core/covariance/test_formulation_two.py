import numpy as np
import pytest

from ssmpipe.core.covariance import formulation_one, formulation_two
from ssmpipe.core.covariance.formulation_one import weighted_covariance
from ssmpipe.core.covariance.formulation_two import (
    chord_weights,
    quadrangle_weights,
    size_weighted_covariance,
    size_weighted_covariance_adjoint,
    size_weights,
    size_weights_adjoint,
)
from ssmpipe.core.covariance.quadrature import gauss, midpoints, tensor
from ssmpipe.core.covariance.sampling import sample
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from tests.support.cohorts import (
    line_bumps,
    plane_bumps,
    random_map,
    random_square_map,
    random_surfaces,
    slope,
)
from tests.support.surfaces import taylor_rate


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


# -- four quarter arcs (Li 2015, section 3.4.1) ------------------------------------------------------------------------


def arcs(angles):
    """Return the four arcs [3.34] at (4, n) angles: points and derivatives in the angle, (4, n, 2)."""
    s, c = np.sin(angles), np.cos(angles)
    x = np.stack([s[0], 1 - c[1], 1 - c[2], s[3]])
    y = np.stack([c[0], s[1], 1 - s[2], 1 - c[3]])
    dx = np.stack([c[0], s[1], s[2], c[3]])
    dy = np.stack([-s[0], c[1], -c[2], s[3]])
    return np.stack([x, y], axis=-1), np.stack([dx, dy], axis=-1)


def by_angle(u):
    return np.tile(0.5 * np.pi * u, (4, 1))


def by_x(u):
    """Angles at which every arc's x is evenly spaced."""
    return np.stack([np.arcsin(u), np.arccos(1 - u), np.arccos(1 - u), np.arcsin(u)])


def by_chord(u):
    """Angles whose points, dropped on the arc's chord, are evenly spaced on it."""
    return np.tile(0.25 * np.pi + np.arcsin((2 * u - 1) / np.sqrt(2)), (4, 1))


def test_exact_norms_of_four_quarter_arcs():
    nodes, base = gauss(np.array([0.0, 1.0]), 40)
    points, slopes = arcs(by_angle(nodes))
    assert np.linalg.norm(weighted_covariance(points, base)) == pytest.approx(0.12836401, abs=5e-9)
    two = size_weighted_covariance(points, (slopes,), base)
    assert np.linalg.norm(two) == pytest.approx(0.11995062, abs=5e-9)


@pytest.mark.parametrize(
    ("angles", "plain", "weighted"),
    [(by_angle, 0.1284, 0.1200), (by_x, 0.1309, 0.1309), (by_chord, 0.1200, 0.1200)],
)
def test_limits_of_three_samplings(angles, plain, weighted):
    """Weighted by x the thesis prints 0.1310; the mean arc is then evenly sampled, so it must equal the plain 0.1309."""
    points, _ = arcs(angles(np.linspace(0, 1, 20001)))
    uniform = np.full(points.shape[1], 1 / points.shape[1])
    assert np.linalg.norm(weighted_covariance(points, uniform)) == pytest.approx(plain, abs=5e-5)
    weights = chord_weights(points.mean(axis=0))
    assert np.linalg.norm(weighted_covariance(points, weights)) == pytest.approx(weighted, abs=5e-5)


# -- weights -----------------------------------------------------------------------------------------------------------


def test_weights_of_a_graded_line_and_a_graded_plane():
    nodes, base = midpoints(50)
    weights = size_weights(base, (np.stack([2 * nodes, 0 * nodes], axis=1),))
    np.testing.assert_allclose(weights, 2 * nodes / 50, atol=1e-15)
    rule = tensor(midpoints(8), midpoints(9))
    u, v = rule.parameters.T
    tangents = (np.stack([3 * u**2, 0 * u, 0 * u], axis=1), np.stack([0 * v, 2 * v, 0 * v], axis=1))
    expected = u**2 * v
    np.testing.assert_allclose(size_weights(rule.weights, tangents), expected / expected.sum(), atol=1e-15)


def test_polygon_and_quadrangle_weights_approach_the_analytic_ones():
    curves, surfaces = line_bumps(), plane_bumps()
    errors = []
    for n in (100, 200, 400):
        u = np.linspace(0, 1, n + 1)[:, None]
        jet = sample(curves, u)
        density = chord_weights(jet.points.mean(axis=0))[1:-1] * n
        analytic = np.linalg.norm(jet.first[0].mean(axis=0), axis=1)[1:-1]
        errors.append(np.abs(density / density.mean() - analytic / analytic.mean()).max())
    assert slope([100, 200, 400], errors) > 0.9
    grid = tensor((np.linspace(0, 1, 81), np.ones(81) / 81), (np.linspace(0, 1, 81), np.ones(81) / 81))
    mean = sample(surfaces, grid.parameters).points.mean(axis=0).reshape(81, 81, 3)
    weights = quadrangle_weights(mean)
    c = weighted_covariance(sample(surfaces, grid.parameters).points, weights)
    assert relative(c, formulation_two.covariance_gauss(surfaces)) < 5e-3


def test_a_mean_without_length_is_refused():
    with pytest.raises(GeometryError, match="no length or area"):
        size_weights(np.ones(3) / 3, (np.zeros((3, 2)),))


# -- convergence and invariance (figures 3.7, 3.10, 3.11) --------------------------------------------------------------


def norm_and_first_eigenvalue(c):
    return np.array([np.linalg.norm(c), np.linalg.eigvalsh(c)[-1]])


@pytest.mark.parametrize("tilt", [0.0, 0.3])
@pytest.mark.parametrize(("cohort", "counts"), [(line_bumps, [160, 320, 640]), (plane_bumps, [72, 144, 288])])
def test_midpoints_converge_with_order_two_to_the_gauss_value(cohort, counts, tilt):
    shapes = cohort(tilt=tilt)
    n_par = len(shapes[0].degrees)
    limit = norm_and_first_eigenvalue(formulation_two.covariance_gauss(shapes))
    errors = [
        np.abs(norm_and_first_eigenvalue(formulation_two.covariance_midpoint(shapes, (n,) * n_par)) - limit)
        for n in counts
    ]
    for column in np.transpose(errors):
        assert slope(counts, column) == pytest.approx(2, abs=0.05)


def test_midpoints_converge_with_order_two_under_a_reparameterization_to_the_same_value():
    curves = line_bumps(tilt=0.3)
    limit = norm_and_first_eigenvalue(formulation_two.covariance_gauss(curves, n_per_span=(40,)))
    maps = [random_map(np.random.default_rng(1), 5, 2)] * len(curves)
    counts = [40, 80, 160, 320, 640]
    errors = []
    for n in counts:
        values = [
            norm_and_first_eigenvalue(formulation_two.covariance_midpoint(curves, (n + k,), maps)) for k in range(8)
        ]
        errors.append(np.sqrt(np.mean(np.square(values - limit), axis=0)))
    for column in np.transpose(errors):
        assert slope(counts, column) == pytest.approx(2, abs=0.15)


def test_few_gauss_points_beat_many_midpoints():
    surfaces = plane_bumps()
    limit = formulation_two.covariance_gauss(surfaces)
    by_gauss = formulation_two.covariance_gauss(surfaces, n_per_span=(3, 3))
    assert relative(by_gauss, limit) < relative(formulation_two.covariance_midpoint(surfaces, (144, 144)), limit)


def test_curves_invariant_under_a_common_reparameterization():
    curves = line_bumps()
    plain = formulation_two.covariance_gauss(curves)
    for seed in range(3):
        maps = [random_map(np.random.default_rng(seed), 6, 2)] * len(curves)
        assert relative(formulation_two.covariance_gauss(curves, maps), plain) < 1e-9
        assert relative(formulation_one.covariance_gauss(curves, maps), formulation_one.covariance_exact(curves)) > 0.02


def test_surfaces_invariant_under_a_common_reparameterization():
    surfaces = plane_bumps()
    maps = [random_square_map(np.random.default_rng(3), 6, 2, size=0.08)] * len(surfaces)
    two = formulation_two.covariance_gauss(surfaces, maps)
    one = formulation_one.covariance_gauss(surfaces, maps)
    # the spans are not polynomial pieces of S(D), so the rule converges algebraically
    assert relative(two, formulation_two.covariance_gauss(surfaces)) < 1e-5
    assert relative(one, formulation_one.covariance_exact(surfaces)) > 0.01


def test_not_invariant_under_different_reparameterizations():
    rng, curves = np.random.default_rng(0), line_bumps()
    knots_of = random_map(rng, 6, 2)
    maps = []
    for _ in curves:
        steps = rng.uniform(0.3, 1, 5)
        values = np.concatenate([[0], np.cumsum(steps) / steps.sum()])
        values[-1] = 1
        maps.append(BSplineCurve(2, knots_of.knots, values[:, None]))
    assert relative(formulation_two.covariance_gauss(curves, maps), formulation_two.covariance_gauss(curves)) > 0.05


# -- gradients ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_par", [1, 2])
def test_gradient_of_the_weights(n_par):
    rng = np.random.default_rng(n_par)
    base = rng.uniform(0.5, 1, 12)
    seed = rng.normal(size=12)
    shape = (n_par, 12, 3)
    x = rng.normal(size=shape)

    def value(flat):
        return float(seed @ size_weights(base, tuple(flat.reshape(shape))) ** 2)

    weights = size_weights(base, tuple(x))
    gradient = np.stack(size_weights_adjoint(base, tuple(x), 2 * seed * weights)).ravel()
    assert taylor_rate(value, gradient, x.ravel(), rng.normal(size=x.size)) > 1.9


def test_gradient_is_zero_where_the_mean_stands_still():
    tangents = (np.array([[1.0, 0.0], [0.0, 0.0], [2.0, 1.0]]),)
    gradient = size_weights_adjoint(np.ones(3) / 3, tangents, np.array([1.0, 2.0, 3.0]))[0]
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(gradient[1], 0)


@pytest.mark.parametrize("n_par", [1, 2])
def test_gradient_of_the_covariance_in_points_and_derivatives(n_par):
    rng = np.random.default_rng(10 + n_par)
    n_s, n_p = 4, 9
    base = rng.uniform(0.5, 1, n_p)
    seed = rng.normal(size=(n_s, n_s))
    shape = (1 + n_par, n_s, n_p, 3)
    x = rng.normal(size=shape)

    def value(flat):
        points, *first = flat.reshape(shape)
        return float((seed * np.sin(size_weighted_covariance(points, tuple(first), base))).sum())

    c = size_weighted_covariance(x[0], tuple(x[1:]), base)
    d_points, d_first = size_weighted_covariance_adjoint(x[0], tuple(x[1:]), base, seed * np.cos(c))
    gradient = np.stack([d_points, *d_first]).ravel()
    for part in range(1 + n_par):  # each argument alone, then all together
        direction = np.zeros(shape)
        direction[part] = rng.normal(size=shape[1:])
        assert taylor_rate(value, gradient, x.ravel(), direction.ravel()) > 1.9
    assert taylor_rate(value, gradient, x.ravel(), rng.normal(size=x.size)) > 1.9


def test_adjoint_is_the_transpose_of_the_tangent():
    """<dC, A> = <d(points, first), adjoint(A)> with the tangent by central differences."""
    surfaces = random_surfaces(np.random.default_rng(0), 3, (5, 5), (2, 2))
    rule = tensor(midpoints(6), midpoints(7))
    jet = sample(surfaces, rule.parameters)
    rng = np.random.default_rng(1)
    move = [rng.normal(size=jet.points.shape) for _ in range(3)]
    seed = rng.normal(size=(3, 3))
    h = 1e-5

    def at(t):
        first = tuple(f + t * m for f, m in zip(jet.first, move[1:], strict=True))
        return size_weighted_covariance(jet.points + t * move[0], first, rule.weights)

    tangent = float((seed * (at(h) - at(-h))).sum()) / (2 * h)
    d_points, d_first = size_weighted_covariance_adjoint(jet.points, jet.first, rule.weights, seed)
    cotangent = sum(float((g * m).sum()) for g, m in zip((d_points, *d_first), move, strict=True))
    assert cotangent == pytest.approx(tangent, rel=1e-7)


def test_gradient_carries_through_to_control_points():
    curves = line_bumps()
    nodes, base = gauss(curves[0].knots, 4)
    values = design_matrix(nodes, curves[0].knots, 2)
    slopes = design_matrix(nodes, curves[0].knots, 2, 1)
    x = np.stack([c.control_points for c in curves])

    def value(flat):
        control = flat.reshape(x.shape)
        moved = [BSplineCurve(2, curves[0].knots, c) for c in control]
        return float(np.linalg.norm(formulation_two.covariance_gauss(moved, n_per_span=(4,))) ** 2)

    c = size_weighted_covariance(values @ x, (slopes @ x,), base)
    d_points, (d_first,) = size_weighted_covariance_adjoint(values @ x, (slopes @ x,), base, 2 * c)
    gradient = (values.T @ d_points + slopes.T @ d_first).ravel()
    assert taylor_rate(value, gradient, x.ravel(), np.random.default_rng(0).normal(size=x.size)) > 1.9


# -- chain rule of the samples -----------------------------------------------------------------------------------------


def test_derivatives_of_composed_samples():
    rng = np.random.default_rng(2)
    surfaces = random_surfaces(rng, 2, (6, 5), (2, 3))
    maps = [random_square_map(rng, 5, 2) for _ in surfaces]
    u = rng.uniform(0.1, 0.9, size=(20, 2))
    jet, h = sample(surfaces, u, maps), 1e-6
    for axis in range(2):
        step = h * np.eye(2)[axis]
        difference = (sample(surfaces, u + step, maps).points - sample(surfaces, u - step, maps).points) / (2 * h)
        np.testing.assert_allclose(jet.first[axis], difference, atol=1e-6)


def test_maps_that_do_not_fit_are_refused():
    curves = line_bumps()
    with pytest.raises(GeometryError, match="1 reparameterizations of dimension 1 do not fit 4 shapes"):
        sample(curves, np.zeros((3, 1)), [random_map(np.random.default_rng(0), 5, 2)])
