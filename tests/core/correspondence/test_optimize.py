import numpy as np
import pytest

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import GeometryError
from tests.support.surfaces import bump, bumps

FAST = EngineOptions(
    n_coefficients=(7, 7), landmarks=(25, 25), prior=0.0, normalize="none", pose="keep", lambda_cut=1e-3
)


def test_a_translated_bump_becomes_one_mode():
    surfaces = [bump((x, 30.0), 20.0) for x in (20.0, 26.0, 34.0, 40.0)]
    optimum = optimize_correspondence(surfaces, FAST).value
    before = optimum.eigenvalues_initial[0] / optimum.eigenvalues_initial.sum()
    after = optimum.eigenvalues[0] / optimum.eigenvalues.sum()
    assert before < 0.9
    assert after > 0.995
    assert optimum.description_length[1] < optimum.description_length[0] - 3
    assert all(c.verdict == "proved" for c in optimum.certificates)


def test_every_iterate_is_feasible_and_rounds_do_not_increase_the_length():
    result = optimize_correspondence(bumps(5), FAST)
    assert result.history["min_jacobian"].min() > 0
    assert np.all(result.history["max_constraint"] < 0)
    assert result.history["description_length"][-1] < result.history["description_length"][0]


def test_same_input_same_bits():
    a = optimize_correspondence(bumps(4), FAST).value
    b = optimize_correspondence(bumps(4), FAST).value
    assert a.points.tobytes() == b.points.tobytes()


def test_points_lie_on_the_surfaces_and_the_reference_does_not_move():
    options = EngineOptions(n_coefficients=(7, 7), landmarks=(25, 25), reference=2)
    optimum = optimize_correspondence(bumps(4), options).value
    np.testing.assert_array_equal(optimum.points[2], optimum.initial_points[2])
    assert np.abs(optimum.points[0] - optimum.initial_points[0]).max() > 0.5


def test_rigid_motion_of_all_shapes_changes_nothing_but_the_pose():
    from scipy.spatial.transform import Rotation

    from ssmpipe.core.spline.surface import BSplineSurface

    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    surfaces = bumps(4)
    moved = [BSplineSurface(s.degree, s.knots_u, s.knots_v, s.control_points @ turn.T + 7.0) for s in surfaces]
    a, b = (optimize_correspondence(s, FAST).value for s in (surfaces, moved))
    np.testing.assert_allclose(a.parameters, b.parameters, atol=1e-4)
    assert a.description_length[1] == pytest.approx(b.description_length[1], abs=1e-3)


def test_one_shape_is_refused():
    with pytest.raises(GeometryError, match="at least two shapes, got 1"):
        optimize_correspondence(bumps(1))
