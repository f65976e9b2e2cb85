import numpy as np
import pytest

from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.statistics.discriminant import cross_validate, discriminant, shrunk_covariance


def cohort(gap, n=40, seed=0):
    rng = np.random.default_rng(seed)
    labels = np.repeat([0, 1], n // 2)
    points = rng.normal(size=(n, 6, 2)) * np.linspace(3, 1, 12).reshape(6, 2)
    points[labels == 1] += gap
    return points, labels


def along_modes(points):
    _, _, variances, scores = principal_components(points)
    return scores * np.sqrt(variances)


def test_shrinkage_vanishes_with_many_rows_and_is_complete_for_few():
    rng = np.random.default_rng(0)
    true = np.diag([9.0, 4.0, 1.0])
    many = rng.multivariate_normal(np.zeros(3), true, size=20000)
    covariance, shrinkage = shrunk_covariance(many)
    assert shrinkage < 0.01
    assert np.allclose(covariance, true, atol=0.2)
    few = rng.normal(size=(4, 30))
    assert np.linalg.eigvalsh(shrunk_covariance(few)[0])[0] > 0.1
    assert shrunk_covariance(few)[1] > 0.5


def test_the_walk_leads_from_one_mean_to_the_other():
    points, labels = cohort(0.0, n=4000)
    points[labels == 1, 2] += [2.0, -1.0]
    found = discriminant(points, (points - points.mean(axis=0)).reshape(4000, -1), labels, 3998)
    apart = found.scores[labels == 1].mean() - found.scores[labels == 0].mean()
    means = [points[labels == g].mean(axis=0) for g in (0, 1)]
    assert np.allclose(found.centre, (means[0] + means[1]) / 2)
    assert np.allclose(apart * found.step, means[1] - means[0], atol=0.1)
    inside = np.concatenate([found.scores[labels == g] - found.scores[labels == g].mean() for g in (0, 1)])
    assert inside.std() == pytest.approx(1.0, abs=1e-3)


def test_swapping_the_groups_changes_only_the_sign():
    points, labels = cohort(0.7)
    values = along_modes(points)[:, :4]
    one, other = discriminant(points, values, labels, 38), discriminant(points, values, 1 - labels, 38)
    assert np.allclose(one.scores, -other.scores)
    assert np.allclose(one.step, -other.step)


def test_clear_groups_are_sorted_and_equal_ones_are_not():
    subjects = np.arange(40)
    for gap, low, high in ((3.0, 0.9, 1.0), (0.0, 0.2, 0.75)):
        points, labels = cohort(gap)
        found = cross_validate(along_modes(points), labels, subjects, 4, np.random.default_rng(0))
        assert low <= found.accuracy <= high
        assert found.low < found.accuracy <= found.high
        assert found.n_folds == 10
        assert found.balanced == pytest.approx((found.predicted == labels).mean())


def test_swapping_the_groups_sorts_the_same():
    rng = np.random.default_rng(0)
    labels, subjects = rng.permuted(np.repeat([0, 1], 15)), np.arange(30) // 2
    values = rng.normal(size=(30, 6))
    straight, swapped = (
        cross_validate(values, marks, subjects, 4, np.random.default_rng(5)) for marks in (labels, 1 - labels)
    )
    assert np.array_equal(straight.predicted, 1 - swapped.predicted)
    assert straight.accuracy == swapped.accuracy


def test_subjects_are_never_on_both_sides():
    # each subject has its own place and the group is a toss-up: whoever sees the twin row knows the answer
    rng = np.random.default_rng(1)
    subjects = np.repeat(np.arange(30), 2)
    labels = rng.permuted(np.repeat([0, 1], 15))[subjects]
    values = np.eye(30)[subjects] * 10 + 0.01 * rng.normal(size=(60, 30))
    honest = cross_validate(values, labels, subjects, 25, np.random.default_rng(0))
    leaky = cross_validate(values, labels, np.arange(60), 29, np.random.default_rng(0))
    assert leaky.accuracy > 0.9
    assert honest.accuracy < 0.7


def test_a_covariate_that_explains_the_groups_takes_their_difference_away():
    rng = np.random.default_rng(2)
    points, labels = cohort(0.0, n=60)
    age = 4.0 * labels[:, None] + 2.0 * rng.normal(size=(60, 1))
    values = along_modes(points)
    values[:, :3] += 2 * age
    plain = cross_validate(values, labels, np.arange(60), 4, np.random.default_rng(0))
    adjusted = cross_validate(values, labels, np.arange(60), 4, np.random.default_rng(0), covariates=age)
    assert plain.accuracy > 0.75
    assert adjusted.accuracy < 0.7


def test_the_interval_is_that_of_clopper_and_pearson():
    points, labels = cohort(30.0, n=20)
    found = cross_validate(along_modes(points), labels, np.arange(20), 3, np.random.default_rng(0))
    assert (found.accuracy, found.high) == (1.0, 1.0)
    assert found.low == pytest.approx(0.025 ** (1 / 20))
