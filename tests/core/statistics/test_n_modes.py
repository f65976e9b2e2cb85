import numpy as np
import pytest

from ssmpipe.core.statistics.n_modes import modes_for_share, modes_to_keep, parallel_analysis


@pytest.mark.parametrize("n_true", [0, 1, 3])
def test_parallel_analysis_finds_the_modes_that_are_there(n_true):
    rng = np.random.default_rng(n_true)
    flat = rng.normal(size=(40, 60))
    directions = np.linalg.qr(rng.normal(size=(60, 3)))[0][:, :n_true]
    flat += rng.normal(size=(40, n_true)) * 12.0 @ directions.T
    centred = flat - flat.mean(axis=0)
    variances = np.linalg.eigvalsh(centred @ centred.T / 39)[::-1][:-1]
    thresholds = parallel_analysis(flat, np.random.default_rng(0))
    assert modes_to_keep(variances, thresholds, 39, share=1e-9).by_parallel_analysis == n_true


def test_the_larger_count_within_what_the_sample_allows():
    variances = np.array([5.0, 3.0, 1.0, 0.5, 0.5])
    low, high = np.zeros(5), np.full(5, 99.0)
    assert modes_for_share(variances, 0.9) == 3
    assert modes_to_keep(variances, high, 60, share=0.9).kept == 3
    assert modes_to_keep(variances, high, 60).kept == 5
    assert modes_to_keep(variances, low, 60).kept == 5
    assert modes_to_keep(variances, low, 6).kept == 2
    assert modes_to_keep(variances, high, 1).kept == 1


def test_seeds_repeat():
    flat = np.random.default_rng(0).normal(size=(6, 9))
    assert np.array_equal(*(parallel_analysis(flat, np.random.default_rng(3)) for _ in range(2)))
