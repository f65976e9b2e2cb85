import numpy as np
import pytest

from ssmpipe.core.statistics.covariates import group_contrast
from ssmpipe.core.statistics.permutation import exchanges
from ssmpipe.core.statistics.pointwise import outward_normals, point_tests, signed_distances
from tests.support.models import grid_points, shape_model

LABELS = np.repeat([0, 1], 10)


def test_normals_of_a_sphere_point_outward_at_the_poles_too():
    points = grid_points("closed", 24, 13)
    model = shape_model("closed", 24, 13)
    normals = outward_normals(points, model.faces)
    assert np.allclose(normals, points / 10, atol=0.05)
    assert np.ptp(normals.reshape(24, 13, 3)[:, -1], axis=0).max() == 0


@pytest.mark.parametrize("turn", [1, -1])
def test_normals_of_a_closed_curve_point_outward_whichever_way_it_runs(turn):
    t = 2 * np.pi * turn * np.arange(40) / 40
    circle = np.stack([3 + np.cos(t), np.sin(t)], axis=1)
    normals = outward_normals(circle, np.empty((0, 3), dtype=np.int64), closed=True)
    assert np.allclose(normals, circle - [3, 0])
    assert np.allclose(signed_distances(3 * (circle - [3, 0]) + [3, 0], circle, normals), 2.0)


def test_a_curve_in_space_has_no_side():
    with pytest.raises(ValueError, match="no outward side"):
        outward_normals(np.zeros((4, 3)), np.empty((0, 3), dtype=np.int64))


@pytest.mark.parametrize("dimensions", [(), (3,)])
def test_a_difference_at_known_points_is_found_there_and_only_there(dimensions):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(20, 200, *dimensions))
    values[10:, 50:70] += 3.0
    found = point_tests(values, group_contrast(LABELS), exchanges(np.arange(20), 999, rng))
    changed = np.zeros(200, dtype=bool)
    changed[50:70] = True
    assert (found.q[changed] <= 0.05).mean() > 0.9
    assert (found.p_family[changed] <= 0.05).mean() > 0.9
    assert (found.p_family[~changed] <= 0.05).sum() == 0
    assert (found.q[~changed] <= 0.05).mean() < 0.05
    assert np.all(found.q >= found.p)
    assert np.all(found.p_family >= found.p)


def test_copies_of_a_point_count_once():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(20, 30)) + np.where(np.arange(30) < 2, 2.0, 0.0) * LABELS[:, None]
    moves = exchanges(np.arange(20), 499, rng)
    plain = point_tests(values, group_contrast(LABELS), moves)
    repeated = point_tests(
        np.concatenate([values, values[:, :1].repeat(40, axis=1)], axis=1), group_contrast(LABELS), moves
    )
    assert np.array_equal(repeated.q[:30], plain.q)
    assert np.array_equal(repeated.p_family[30:], np.full(40, plain.p_family[0]))


def test_a_point_that_never_moves_is_no_discovery():
    values = np.random.default_rng(2).normal(size=(20, 4))
    values[:, 2] = 1.0
    found = point_tests(values, group_contrast(LABELS), exchanges(np.arange(20), 99, np.random.default_rng(0)))
    assert (found.p[2], found.q[2], found.p_family[2]) == (1.0, 1.0, 1.0)
