import numpy as np
import pytest

from ssmpipe.core.statistics.effect_size import (
    cohen_d,
    effect_interval,
    hedges_g,
    mahalanobis,
    smallest_detectable,
)


def test_hedges_g_is_unbiased_where_cohens_d_is_not():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(20000, 10))
    a, b = values[:, :5], values[:, 5:] + 1.0
    residuals = np.concatenate([a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)], axis=1).T
    d = cohen_d((b.mean(1) - a.mean(1)), residuals, 8)
    assert d.mean() == pytest.approx(1.107, abs=0.02)
    assert hedges_g(d, 8).mean() == pytest.approx(1.0, abs=0.02)


def test_the_interval_covers():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(4000, 15)), rng.normal(size=(4000, 15)) + 0.8
    residuals = np.concatenate([a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)], axis=1).T
    low, high = effect_interval(hedges_g(cohen_d(b.mean(1) - a.mean(1), residuals, 28), 28), 15, 15)
    assert ((low < 0.8) & (high > 0.8)).mean() == pytest.approx(0.95, abs=0.012)


def test_mahalanobis_ignores_linear_maps_and_needs_degrees():
    rng = np.random.default_rng(2)
    residuals, gap = rng.normal(size=(30, 4)), rng.normal(size=4)
    linear = rng.normal(size=(4, 4))
    assert mahalanobis(gap @ linear, residuals @ linear, 28) == pytest.approx(mahalanobis(gap, residuals, 28))
    assert np.isnan(mahalanobis(gap, residuals, 3))


def test_the_detectable_difference_has_the_power_that_it_says():
    d = smallest_detectable(8, 12)
    rng = np.random.default_rng(3)
    from scipy import stats

    a, b = rng.normal(size=(8, 20000)), rng.normal(size=(12, 20000)) + d
    assert (stats.ttest_ind(a, b).pvalue < 0.05).mean() == pytest.approx(0.8, abs=0.01)
    assert np.isnan(smallest_detectable(1, 1))


def test_nothing_varies():
    assert np.isnan(cohen_d(np.array([1.0]), np.zeros((4, 1)), 2)[0])
