import numpy as np
import pytest

from ssmpipe.core.correspondence.barrier import Barrier
from ssmpipe.core.correspondence.measure import landmark_rule
from ssmpipe.core.correspondence.normals import NormalFields
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.sensitivity import direct_gradient, finite_difference_gradient
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.spline.basis import design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.knots import clamped_uniform_knots
from tests.support.surfaces import bumps, taylor_rate

t = np.linspace(0, 2 * np.pi, 60)


def fit_curve_through(points):
    knots = clamped_uniform_knots(14, 3)
    design = design_matrix(np.linspace(0, 1, len(points)), knots, 3)
    control = np.linalg.lstsq(design, points, rcond=None)[0]
    control[-1] = control[0]
    return BSplineCurve(3, knots, control)


CURVES = [fit_curve_through(np.stack([np.cos(t), np.sin(t) * (1 + 0.3 * k)], axis=1)) for k in range(4)]


def objective(
    covariance="discrete",
    boundary="fixed",
    reference=1,
    spectral="description-length",
    curves=False,
    window=None,
    normals=0.0,
    **options,
):
    n, grid = ((7,), (31,)) if curves else ((7, 6), (21, 23))
    space = Reparameterization(n, grid, boundary=boundary, window=window)
    nodes, base = landmark_rule(space, grid, "grid" if covariance == "discrete" else "gauss")
    splines = CURVES if curves else bumps(5)
    if normals:
        fields = NormalFields(splines[0], space.periodic)
        splines, options["n_positions"] = [fields.beside(s, normals) for s in splines], splines[0].dimension
    stack = SplineStack(splines, space.periodic)
    function = spectral_function(spectral, 1e-3)
    return GroupObjective(
        stack, space.at(nodes), function, base_weights=base, covariance=covariance, reference=reference, **options
    )


def check_gradient(f, seed=0):
    rng = np.random.default_rng(seed)
    x = f.start() + f._keep_gauge(0.01 * rng.normal(size=f.start().size))
    direction = f._keep_gauge(rng.normal(size=x.size))
    direction /= np.linalg.norm(direction) * 10
    return taylor_rate(lambda y: f.value_and_gradient(y)[0], f.value_and_gradient(x)[1], x, direction)


@pytest.mark.parametrize("covariance", ["discrete", "I", "II"])
@pytest.mark.parametrize("boundary", ["fixed", "sliding", "periodic"])
@pytest.mark.parametrize("reference", [1, -1])
@pytest.mark.parametrize("curves", [False, True])
def test_gradient_is_exact(covariance, boundary, reference, curves):
    f = objective(
        covariance, boundary, reference, curves=curves, prior=0.3, barrier=0.7, constraint=Barrier(floor=0.05)
    )
    assert check_gradient(f) > 1.8


@pytest.mark.parametrize("covariance", ["discrete", "I", "II"])
@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
@pytest.mark.parametrize("curves", [False, True])
def test_gradient_with_normals_is_exact(covariance, boundary, curves):
    f = objective(covariance, boundary, curves=curves, normals=0.5 if curves else 15.0, prior=0.3, barrier=0.7)
    assert f.evaluate(f.start()).jet.points.shape[2] == (4 if curves else 6)
    assert check_gradient(f) > 1.8


def test_weights_of_the_mean_shape_are_those_of_positions_alone():
    with_normals, without = objective("II", normals=15.0), objective("II")
    x = without.start()
    np.testing.assert_array_equal(with_normals.evaluate(x).weights, without.evaluate(x).weights)


@pytest.mark.parametrize("reference", [1, -1])
def test_hessian_product_with_normals(reference):
    f = objective("I", reference=reference, normals=15.0, prior=0.3, barrier=0.7)
    rng = np.random.default_rng(3)
    x = f.start() + f._keep_gauge(0.01 * rng.normal(size=f.start().size))
    direction = f._keep_gauge(rng.normal(size=x.size))
    forward, back = (f.value_and_gradient(x + h * direction)[1] for h in (1e-7, -1e-7))
    product = f.hessian(x)(direction)
    np.testing.assert_allclose(product, (forward - back) / 2e-7, atol=1e-5 * np.abs(product).max())


def test_direct_and_adjoint_agree_with_normals():
    f = objective(normals=15.0, barrier=0)
    x = f.start() + 0.01 * np.random.default_rng(9).normal(size=f.start().size)
    np.testing.assert_allclose(direct_gradient(f, x), f.spectral_gradient(x)[1], rtol=1e-6, atol=1e-9)


WINDOWS = [
    ("fixed", Window((0.1, 0.05), (0.9, 0.97))),
    ("periodic", Window((0.0, 0.05), (1.0, 1.0))),
    ("periodic", Window((0.0, 0.1), (1.0, 0.95))),
]


@pytest.mark.parametrize("covariance", ["discrete", "I", "II"])
@pytest.mark.parametrize(("boundary", "window"), WINDOWS)
@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_gradient_with_open_edges_is_exact(covariance, boundary, window, aggregate):
    barrier = Barrier(aggregate, 0.05)
    f = objective(covariance, boundary, -1, window=window, prior=0.3, barrier=0.7, constraint=barrier)
    assert f.walls(f.start()).shape[1] > f.jacobians(f.start()).shape[1]
    assert check_gradient(f) > 1.8


@pytest.mark.parametrize(("boundary", "window"), WINDOWS)
@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_hessian_product_with_open_edges(boundary, window, aggregate):
    barrier = Barrier(aggregate, 0.05)
    f = objective("I", boundary, -1, window=window, prior=0.3, barrier=0.7, constraint=barrier)
    rng = np.random.default_rng(3)
    x = f.start() + f._keep_gauge(0.004 * rng.normal(size=f.start().size))
    direction = f._keep_gauge(rng.normal(size=x.size))
    forward, back = (f.value_and_gradient(x + h * direction)[1] for h in (1e-7, -1e-7))
    product = f.hessian(x)(direction)
    np.testing.assert_allclose(product, (forward - back) / 2e-7, atol=1e-6 * np.abs(product).max())


@pytest.mark.parametrize("spectral", ["description-length", "log-determinant", "trace"])
def test_gradient_of_every_spectral_function_is_exact(spectral):
    assert check_gradient(objective(spectral=spectral, barrier=0)) > 1.8


@pytest.mark.parametrize("form", ["bezier", "bspline", "sampled"])
@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_gradient_of_every_constraint_is_exact(form, aggregate):
    f = objective(form=form, constraint=Barrier(aggregate, 0.0, 25.0), barrier=5.0)
    assert check_gradient(f) > 1.8


@pytest.mark.parametrize("covariance", ["discrete", "I"])
@pytest.mark.parametrize("curves", [False, True])
def test_gradient_through_the_alignment_is_exact(covariance, curves):
    f = objective(covariance, curves=curves, barrier=0)
    f.target = f.evaluate(f.start()).jet.points[0] * 1.1
    f._last = None
    assert check_gradient(f) > 1.8


def test_a_gradient_wrong_by_a_thousandth_is_seen():
    f = objective()
    rng = np.random.default_rng(0)
    x = f.start() + 0.01 * rng.normal(size=f.start().size)
    direction = rng.normal(size=x.size)
    direction /= np.linalg.norm(direction) * 10
    assert taylor_rate(lambda y: f.value_and_gradient(y)[0], 1.001 * f.value_and_gradient(x)[1], x, direction) < 1.5


@pytest.mark.parametrize("curves", [False, True])
def test_direct_adjoint_and_differences_agree(curves):
    f = objective(curves=curves, barrier=0)
    rng = np.random.default_rng(0)
    x = f.start() + 0.01 * rng.normal(size=f.start().size)
    adjoint = f.spectral_gradient(x)[1]
    direct = direct_gradient(f, x)
    differences = finite_difference_gradient(f, x, 1e-7)
    assert np.abs(direct - adjoint).max() < 1e-9 * np.abs(adjoint).max()
    assert np.abs(differences - adjoint).max() < 1e-4 * np.abs(adjoint).max()


def test_outside_the_feasible_set_the_objective_is_infinite():
    f = objective()
    assert f.value_and_gradient(f.start() + 0.6 * np.random.default_rng(0).normal(size=f.start().size))[0] == np.inf


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
    length = spectral_function("description-length", 1e-3)
    surfaces = bumps(5)
    reparameterization = Reparameterization((6, 6), (21, 21))
    order = [3, 0, 4, 1, 2]
    a = GroupObjective(SplineStack(surfaces), reparameterization, length)
    b = GroupObjective(SplineStack([surfaces[i] for i in order]), reparameterization, length)
    assert a.spectral_value(a.start()) == pytest.approx(b.spectral_value(b.start()), rel=1e-10)


def test_preconditioner_is_symmetric_and_positive():
    f = objective(prior=0.1, barrier=1.0)
    x = f.start() + 0.005 * np.random.default_rng(1).normal(size=f.start().size)
    apply = f.preconditioner(x)
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, x.size))
    assert a @ apply(b) == pytest.approx(b @ apply(a), rel=1e-8)
    assert a @ apply(a) > 0


@pytest.mark.parametrize("boundary", ["fixed", "sliding"])
def test_gauss_newton_block_matches_its_definition(boundary):
    reparameterization = Reparameterization((5, 6), (7, 8), boundary=boundary)
    rng = np.random.default_rng(5)
    metric = rng.normal(size=(56, 2, 2))
    metric = metric + np.swapaxes(metric, 1, 2)
    dense = reparameterization.normal_blocks(metric)
    at_zero = reparameterization.evaluate(np.full((1, 5, 6, 2), 0.25))[0]
    unit = np.eye(5 * 6 * 2).reshape(-1, 5, 6, 2)
    values = np.stack([(reparameterization.evaluate(0.25 + 0.5 * e[None])[0] - at_zero) / 0.5 for e in unit])
    free = np.flatnonzero(reparameterization.free.ravel())
    expected = np.einsum("alc,lcd,bld->ab", values[free], metric, values[free])
    np.testing.assert_allclose(dense, expected, atol=1e-10)


@pytest.mark.parametrize("boundary", ["fixed", "sliding", "periodic"])
@pytest.mark.parametrize("reference", [1, -1])
@pytest.mark.parametrize("curves", [False, True])
@pytest.mark.parametrize("aggregate", ["each", "ks"])
def test_hessian_product_matches_differences_of_the_gradient(boundary, reference, curves, aggregate):
    f = objective("I", boundary, reference, curves=curves, prior=0.3, barrier=0.7, constraint=Barrier(aggregate, 0.05))
    rng = np.random.default_rng(3)
    x = f.start() + f._keep_gauge(0.004 * rng.normal(size=f.start().size))
    direction = f._keep_gauge(rng.normal(size=x.size))
    forward, back = (f.value_and_gradient(x + h * direction)[1] for h in (1e-7, -1e-7))
    product = f.hessian(x)(direction)
    np.testing.assert_allclose(product, (forward - back) / 2e-7, atol=1e-6 * np.abs(product).max())


@pytest.mark.parametrize("spectral", ["description-length", "log-determinant", "trace"])
def test_hessian_product_of_every_spectral_function(spectral):
    f = objective(spectral=spectral, barrier=0)
    rng = np.random.default_rng(3)
    x = f.start() + 0.004 * rng.normal(size=f.start().size)
    direction = rng.normal(size=x.size)
    forward, back = (f.value_and_gradient(x + h * direction)[1] for h in (1e-7, -1e-7))
    product = f.hessian(x)(direction)
    np.testing.assert_allclose(product, (forward - back) / 2e-7, atol=1e-6 * np.abs(product).max())


@pytest.mark.parametrize("boundary", ["fixed", "sliding", "periodic"])
def test_local_normal_blocks_equal_the_dense_product(boundary):
    f = objective(boundary=boundary)
    rng = np.random.default_rng(6)
    b = f.coefficients(f.start() + 0.01 * rng.normal(size=f.start().size))
    curvature = rng.uniform(1, 2, size=(len(b), f.inequalities.jacobian.n))
    for block, one, k in zip(f.inequalities.jacobian.normal_blocks(b, curvature), b, curvature, strict=True):
        rows = f.inequalities.jacobian.rows(one)[:, f.reparameterization.free.ravel()]
        np.testing.assert_allclose(block, rows.T @ (k[:, None] * rows), atol=1e-10 * np.abs(block).max())


@pytest.mark.parametrize("covariance", ["discrete", "II"])
def test_any_number_of_threads_gives_the_same_bits(covariance):
    results = []
    for threads in (1, 2, 3):
        f = objective(covariance, prior=0.1)
        f.stack.threads = threads
        x = f.start() + 0.005 * np.random.default_rng(1).normal(size=f.start().size)
        value, gradient = f.value_and_gradient(x)
        results.append(
            (value, gradient.tobytes(), f.preconditioner(x)(gradient).tobytes(), f.hessian(x)(gradient).tobytes())
        )
    assert results[0] == results[1] == results[2]


def test_followed_multipliers_bend_the_curvature_and_not_the_gradient():
    f = objective(barrier=0.5)
    x = f.start() + 0.004 * np.random.default_rng(3).normal(size=f.start().size)
    before, product, solved = f.value_and_gradient(x)[1], f.hessian(x)(x), f.preconditioner(x)(x)
    f.step_taken(f.start(), x - f.start())
    np.testing.assert_array_equal(f.value_and_gradient(x)[1], before)
    assert not np.allclose(f.hessian(x)(x), product, rtol=1e-6, atol=0)
    assert not np.allclose(f.preconditioner(x)(x), solved, rtol=1e-6, atol=0)


def test_no_direction_rises_faster_than_the_gradient():
    """Table 2.3 of the thesis: of n_V directions in which one coefficient point may go, the steepest nears the adjoint gradient."""
    f = objective(barrier=0)
    rng = np.random.default_rng(8)
    x = f.start() + 0.01 * rng.normal(size=f.start().size)
    gradient = f.spectral_gradient(x)[1]
    point = 2 * int(np.argmax(np.linalg.norm(gradient.reshape(-1, 2), axis=1)))
    adjoint = gradient[point : point + 2]
    size = np.linalg.norm(adjoint)

    def rise(angle):
        step = np.zeros_like(x)
        step[point : point + 2] = np.cos(angle), np.sin(angle)
        return (f.spectral_value(x + 1e-6 * step) - f.spectral_value(x - 1e-6 * step)) / 2e-6

    for n_v in (25, 100, 500):
        angles = 2 * np.pi * np.arange(n_v) / n_v
        rises = np.array([rise(a) for a in angles])
        best = int(rises.argmax())
        steepest = rises[best] * np.array([np.cos(angles[best]), np.sin(angles[best])])
        # the nearest of n_V directions is at most half a step off
        assert np.linalg.norm(steepest - adjoint) < 2 * np.sin(0.5 * np.pi / n_v) * size + 1e-5 * size
        np.testing.assert_allclose(rises, np.cos(angles) * adjoint[0] + np.sin(angles) * adjoint[1], atol=1e-5 * size)


@pytest.mark.parametrize("boundary", ["fixed", "sliding", "periodic"])
@pytest.mark.parametrize("reference", [1, -1])
def test_direct_and_adjoint_agree_to_nine_digits(boundary, reference):
    """Table 2.1 of the thesis, entry by entry where the entry is not next to nothing."""
    f = objective("I", boundary, reference, barrier=0)
    x = f.start() + f._keep_gauge(0.01 * np.random.default_rng(9).normal(size=f.start().size))
    adjoint, direct = f.spectral_gradient(x)[1], direct_gradient(f, x)
    told = np.abs(adjoint) > 1e-6 * np.abs(adjoint).max()
    assert told.mean() > 0.9
    np.testing.assert_allclose(direct[told], adjoint[told], rtol=1e-9)
