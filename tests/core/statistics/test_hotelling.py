from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from ssmpipe.core.statistics.covariates import group_contrast, pair_contrast
from ssmpipe.core.statistics.hotelling import parametric_p, permutation_test, t_squared
from ssmpipe.core.statistics.permutation import exchanges, sign_flips

LABELS = np.array([0] * 5 + [1] * 6)
VALUES = np.random.default_rng(0).normal(size=(11, 3)) + 0.8 * LABELS[:, None]


def draws(n=499, seed=0, blocks=None):
    return exchanges(np.arange(11) if blocks is None else blocks, n, np.random.default_rng(seed))


def test_one_dimension_is_the_t_test():
    contrast = group_contrast(LABELS)
    trace = permutation_test(VALUES[:, :, None], contrast, draws()).statistic
    known = stats.ttest_ind(VALUES[LABELS == 0], VALUES[LABELS == 1])
    assert np.allclose([t_squared(t, 9) for t in trace], known.statistic**2)
    assert np.allclose([parametric_p(t, 1, 1, 9) for t in trace], known.pvalue)


def test_two_groups_are_hotellings_t_squared():
    a, b = VALUES[LABELS == 0], VALUES[LABELS == 1]
    pooled = (4 * np.cov(a.T) + 5 * np.cov(b.T)) / 9
    gap = b.mean(axis=0) - a.mean(axis=0)
    expected = 30 / 11 * gap @ np.linalg.solve(pooled, gap)
    trace = float(permutation_test(VALUES[:, None], group_contrast(LABELS), draws()).statistic[0])
    assert t_squared(trace, 9) == pytest.approx(expected)
    assert parametric_p(trace, 3, 1, 9) == pytest.approx(stats.f.sf(expected * 7 / 27, 3, 7))


def test_more_groups_in_one_dimension_are_the_analysis_of_variance():
    labels = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, 2, 2])
    trace = float(permutation_test(VALUES[:, :1, None], group_contrast(labels), draws()).statistic[0])
    assert parametric_p(trace, 1, 2, 8) == pytest.approx(
        stats.f_oneway(*(VALUES[labels == g, 0] for g in range(3))).pvalue
    )


def test_p_values_agree_with_all_relabellings():
    values = VALUES[3:9]
    labels = LABELS[3:9]
    contrast = group_contrast(labels)
    observed = abs(values[labels == 1].mean(axis=0) - values[labels == 0].mean(axis=0))
    every = []
    for chosen in combinations(range(6), int(labels.sum())):
        is_one = np.isin(np.arange(6), chosen)
        every.append(abs(values[is_one].mean(axis=0) - values[~is_one].mean(axis=0)))
    exact = (np.array(every) >= observed * (1 - 1e-12)).mean(axis=0)
    found = permutation_test(values[:, :, None], contrast, exchanges(np.arange(6), 20000, np.random.default_rng(0)))
    assert np.allclose(found.p, exact, atol=0.015)


def test_agrees_with_scipy_on_a_paired_sample():
    gaps = VALUES[:8, :1] - 0.5
    found = permutation_test(gaps[:, :, None], pair_contrast(8), sign_flips(8, 20000, np.random.default_rng(0)))
    known = stats.permutation_test((gaps[:, 0],), np.mean, permutation_type="samples", n_resamples=np.inf)
    assert found.p[0] == pytest.approx(known.pvalue, abs=0.015)


def test_linear_maps_labels_and_order_change_nothing():
    contrast, moves = group_contrast(LABELS), draws()
    first = permutation_test(VALUES[:, None], contrast, moves)
    mapped = permutation_test((VALUES @ np.array([[2.0, 1, 0], [0, 1, 0], [1, 0, 3]]) + 7)[:, None], contrast, moves)
    swapped = permutation_test(VALUES[:, None], group_contrast(1 - LABELS), moves)
    for other in (mapped, swapped):
        assert np.allclose(other.statistic, first.statistic)
        assert np.array_equal(other.p, first.p)
    again = permutation_test(VALUES[:, None], contrast, draws())
    assert again.p.tobytes() == first.p.tobytes()
    assert permutation_test(VALUES[:, None], contrast, draws(seed=8)).p != first.p


def test_whole_shapes_are_compared_by_squared_distance():
    contrast = group_contrast(LABELS)
    wide = np.random.default_rng(3).normal(size=(11, 40))
    found = permutation_test(wide[:, None], contrast, draws(), whole=True)
    total = ((wide - wide.mean(axis=0)) ** 2).sum()
    between = sum(sum(g == LABELS) * ((wide[g == LABELS].mean(axis=0) - wide.mean(axis=0)) ** 2).sum() for g in (0, 1))
    assert found.statistic[0] == pytest.approx(between / total)
    turned = wide @ np.linalg.qr(np.random.default_rng(4).normal(size=(40, 40)))[0]
    assert permutation_test(turned[:, None], contrast, draws(), whole=True).p == found.p


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("shape", [(11, 3, 1), (11, 1, 3)])
def test_a_covariate_that_explains_all_leaves_no_difference(shape, whole):
    rng = np.random.default_rng(5)
    age = rng.normal(size=(11, 1)) + 2 * LABELS[:, None]
    values = (3 * age + 0.3 * rng.normal(size=(11, 3))).reshape(shape)
    plain = permutation_test(values, group_contrast(LABELS), draws(), whole=whole)
    adjusted = permutation_test(values, group_contrast(LABELS, age), draws(), whole=whole)
    assert plain.p.max() < 0.02
    assert adjusted.p.min() > 0.05


def test_with_a_covariate_the_observed_trace_is_that_of_the_linear_model():
    rng = np.random.default_rng(6)
    age = rng.normal(size=(11, 1))
    trace = permutation_test(VALUES[:, None], group_contrast(LABELS, age), draws()).statistic[0]
    small = np.concatenate([np.ones((11, 1)), age], axis=1)
    large = np.concatenate([small, LABELS[:, None]], axis=1)
    rest = [VALUES - x @ np.linalg.lstsq(x, VALUES, rcond=None)[0] for x in (small, large)]
    total, error = (r.T @ r for r in rest)
    assert trace == pytest.approx(np.trace((total - error) @ np.linalg.inv(total)))


def test_the_general_path_and_the_short_one_agree():
    # the same values as one test of one dimension, by the path for many dimensions
    rng = np.random.default_rng(7)
    contrast = group_contrast(LABELS, rng.normal(size=(11, 2)))
    single = permutation_test(VALUES[:, :1, None], contrast, draws())
    padded = permutation_test(np.concatenate([VALUES[:, :1, None], np.zeros((11, 1, 1))], axis=2), contrast, draws())
    assert padded.statistic == pytest.approx(single.statistic)
    assert np.array_equal(padded.p, single.p)


def test_what_does_not_vary_has_no_p_value_and_does_not_disturb_the_family():
    values = VALUES.copy()
    values[:, 1] = 4.0
    found = permutation_test(values[:, :, None], group_contrast(LABELS), draws())
    assert np.isnan(found.p[1])
    assert np.isnan(found.p_family[1])
    others = permutation_test(values[:, [0, 2], None], group_contrast(LABELS), draws())
    assert np.array_equal(found.p_family[[0, 2]], others.p_family)
    assert np.all(others.p_family >= others.p)


def test_the_f_distribution_needs_degrees():
    assert np.isnan(parametric_p(0.5, 10, 1, 9))
    assert t_squared(1.0, 5) == float("inf")


def test_subjects_with_several_rows_are_not_independent_rows():
    # ten subjects with four equal rows each: as rows a clear difference, as subjects none
    rng = np.random.default_rng(11)
    labels = np.repeat([0, 1], 20)
    subjects = np.repeat(np.arange(10), 4)
    person = rng.normal(size=10)
    values = (person[subjects] + 0.05 * rng.normal(size=40))[:, None, None]
    as_rows = permutation_test(values, group_contrast(labels), exchanges(np.arange(40), 999, np.random.default_rng(0)))
    as_subjects = permutation_test(values, group_contrast(labels), exchanges(subjects, 999, np.random.default_rng(0)))
    expected = stats.ttest_ind(person[:5], person[5:]).pvalue
    assert as_subjects.p[0] == pytest.approx(expected, abs=0.1)
    assert as_rows.p[0] < 0.25 * as_subjects.p[0]
