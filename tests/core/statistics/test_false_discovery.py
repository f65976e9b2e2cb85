import numpy as np
import pytest

from ssmpipe.core.statistics.false_discovery import false_discovery_rate, family_wise, holm


def test_benjamini_and_hochberg_by_hand():
    p = np.array([0.005, 0.009, 0.05, 0.1, 0.2])
    assert np.allclose(false_discovery_rate(p), [0.0225, 0.0225, 0.25 / 3, 0.125, 0.2])


def test_holm_keeps_order_and_never_decreases():
    assert np.allclose(holm(np.array([0.04, 0.01, 0.03])), [0.06, 0.03, 0.06])
    assert np.allclose(holm(np.array([0.5, 0.9])), [1.0, 1.0])
    assert holm(np.array([0.2]))[0] == pytest.approx(0.2)


def test_max_t_counts_ties_and_the_observed_draw():
    largest = np.array([1.0, 2.0, 2.0, 3.0])
    assert np.allclose(family_wise(np.array([2.0, 3.1, 0.1]), largest), [4 / 5, 1 / 5, 1.0])


def test_max_t_is_sharper_than_bonferroni_when_tests_go_together():
    rng = np.random.default_rng(0)
    common = np.abs(rng.normal(size=(2000, 1)) + 0.01 * rng.normal(size=(2000, 50)))
    p = float(family_wise(np.array([2.3]), common.max(axis=1))[0])
    assert p < 0.2 * 50 * float((common[:, 0] >= 2.3).mean())
