import numpy as np

from ssmpipe.core.statistics.covariates import pair_contrast
from ssmpipe.core.statistics.hotelling import permutation_test
from ssmpipe.core.statistics.paired import pairs
from ssmpipe.core.statistics.permutation import sign_flips


def test_several_shapes_of_one_side_are_averaged_and_single_sides_left_out():
    labels = np.array([1, 0, 0, 1, 0])
    subjects = np.array([5, 5, 5, 2, 9])
    found = pairs(labels, subjects)
    values = np.array([[10.0, 0], [4, 1], [6, 3], [7, 7], [8, 8]])
    assert np.array_equal(found.differences(values), [[5.0, -2.0]])
    assert found.subjects.tolist() == [5]
    assert found.left_out.tolist() == [2, 9]


def test_swapping_the_groups_changes_only_the_sign():
    labels, subjects = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
    values = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert np.array_equal(pairs(labels, subjects).differences(values), -pairs(1 - labels, subjects).differences(values))


def test_pairs_find_a_small_difference_between_subjects_who_differ_much():
    rng = np.random.default_rng(1)
    person = 10 * rng.normal(size=(12, 1, 3))
    points = np.concatenate([person, person + [0.3, 0, 0]]) + 0.1 * rng.normal(size=(24, 1, 3))
    labels, subjects = np.repeat([0, 1], 12), np.tile(np.arange(12), 2)
    differences = pairs(labels, subjects).differences(points)
    found = permutation_test(differences, pair_contrast(12), sign_flips(12, 499, np.random.default_rng(0)))
    assert found.p[0] == 1 / 500 or found.p[0] < 0.01
