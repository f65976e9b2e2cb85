import itertools

import numpy as np
import pytest

from ssmpipe.core.baselines import cauchy, clamped_plate
from ssmpipe.core.correspondence.description_length import description_length
from ssmpipe.core.errors import GeometryError
from tests.support.cohorts import line_bumps, plane_bumps


def curves(seed=0, **options):
    options = {"n_warps": 120, **options}
    return cauchy.optimize(
        line_bumps(n_control=30), grid=(41,), lambda_cut=1e-3, reference=1, rng=np.random.default_rng(seed), **options
    )


def surfaces(seed=0, **options):
    options = {"n_warps": 120, **options}
    return clamped_plate.optimize(
        plane_bumps(), grid=(21, 21), lambda_cut=1e-3, reference=1, rng=np.random.default_rng(seed), **options
    )


def plane_search(seed=0, **options):
    return surfaces(seed, search="plane", **options)


BOTH = pytest.mark.parametrize("run", [curves, surfaces])
ALL = pytest.mark.parametrize("run", [curves, surfaces, plane_search])


@ALL
def test_description_length_falls_and_never_rises(run):
    result = run()
    history = result.history["description_length"]
    assert len(history) == 121
    assert np.all(np.diff(history) <= 0)
    assert history[-1] < history[0] - 0.2
    np.testing.assert_array_equal(np.diff(history) < 0, result.history["accepted"][1:] == 1)
    assert result.value.description_length == (history[0], history[-1])


@ALL
def test_running_values_agree_with_the_final_points(run):
    optimum = run().value
    centred = optimum.points - optimum.points.mean(axis=0)
    flat = centred.reshape(len(centred), -1)
    eigenvalues = np.linalg.eigvalsh(flat @ flat.T)[1:] / ((len(centred) - 1) * centred.shape[1])
    assert optimum.description_length[1] == pytest.approx(description_length(eigenvalues, 1e-3), abs=1e-9)


def test_a_trial_foresees_what_a_move_would_give():
    from ssmpipe.core.baselines.concatenation import _Cohort

    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    cohort = _Cohort(plane_bumps(), grid, 1e-3)
    for shape in (2, 0, 2):
        index = np.sort(rng.permutation(81)[:30])
        before, parameters = cohort.value, np.clip(grid[index] + 0.1 * rng.normal(size=(30, 2)), 0, 1)
        foreseen = cohort.trial(shape, index, parameters)
        cohort.value = np.inf  # any move is welcome
        assert cohort.move(shape, index, parameters)
        assert cohort.value == pytest.approx(foreseen, abs=1e-10)
        assert abs(foreseen - before) > 1e-3


@BOTH
def test_the_kept_warps_are_the_whole_reparameterization(run):
    result = run()
    start = result.value.parameters[1]  # the reference keeps the grid
    assert result.value.warps[1] == ()
    assert sum(len(w) for w in result.value.warps) == result.history["accepted"].sum() > 5
    for shape in range(4):
        np.testing.assert_allclose(result.value.evaluate(shape, start), result.value.parameters[shape], atol=1e-12)
    boundary = np.any((start == 0) | (start == 1), axis=1)
    np.testing.assert_array_equal(result.value.parameters[:, boundary], np.repeat(start[None, boundary], 4, axis=0))


@BOTH
def test_same_seed_same_bits_other_seed_other_result(run):
    a, b, c = run(3), run(3), run(4)
    assert a.value.points.tobytes() == b.value.points.tobytes()
    assert a.value.points.tobytes() != c.value.points.tobytes()


def test_the_curves_stay_in_order():
    optimum = curves(n_warps=400).value
    assert np.diff(optimum.parameters[..., 0], axis=1).min() > 0


def test_the_whole_map_of_the_square_has_a_positive_jacobian():
    optimum = surfaces(n_warps=400).value
    dense = np.random.default_rng(0).uniform(size=(5000, 2))
    for warps in optimum.warps:
        points, smallest = dense, np.ones(len(dense))
        for warp in warps:
            jacobian = warp.jacobian(points)
            assert jacobian.min() > 0
            points, smallest = warp(points), smallest * jacobian
        assert smallest.min() > 0
        assert points.min() > 0
        assert points.max() < 1


@BOTH
def test_it_stops_at_a_target_a_budget_or_a_number_of_evaluations(run):
    start = run(n_warps=0).value.description_length[0]
    reached = run(target=start - 0.2)
    assert reached.status == "converged"
    assert reached.history["description_length"][-1] <= start - 0.2 < reached.history["description_length"][-2]
    few = run(max_evaluations=50)
    assert few.status == "out-of-iterations"
    assert 50 <= few.n_evaluations < 90
    assert few.n_evaluations == few.history["evaluations"][-1]
    ticks = itertools.count(10.0, 2.0)
    timed = run(clock=lambda: next(ticks), time_budget_s=9.0)
    np.testing.assert_array_equal(timed.history["elapsed"], [0, 2, 4, 6, 8, 10])
    assert np.isnan(few.history["elapsed"]).all()


def test_a_budget_changes_nothing_but_the_length():
    ticks = itertools.count(0.0)
    short = curves(clock=lambda: next(ticks), time_budget_s=20.0).history["description_length"]
    np.testing.assert_array_equal(short, curves().history["description_length"][: len(short)])


def test_all_shapes_may_move():
    result = cauchy.optimize(
        line_bumps(), grid=(21,), lambda_cut=1e-3, reference=-1, n_warps=100, rng=np.random.default_rng(0)
    )
    assert all(len(w) > 0 for w in result.value.warps)


def test_unusable_requests_are_refused():
    with pytest.raises(GeometryError, match="needs a clock"):
        curves(time_budget_s=1.0)
    rest = {"lambda_cut": 1e-3, "reference": 0, "n_warps": 1, "rng": np.random.default_rng(0)}
    with pytest.raises(GeometryError, match="at least two shapes, got 1"):
        cauchy.optimize(line_bumps()[:1], grid=(9,), **rest)
    with pytest.raises(GeometryError, match="1 parameters, the shapes 2"):
        cauchy.optimize(plane_bumps(), grid=(9,), **rest)
    with pytest.raises(GeometryError, match="the grid 1"):
        clamped_plate.optimize(plane_bumps(), grid=(9,), **rest)
