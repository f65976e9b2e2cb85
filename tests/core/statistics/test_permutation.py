import numpy as np
import pytest

from ssmpipe.core.statistics.permutation import exchanges, n_exchanges, permutation_p, sign_flips


def test_subjects_stay_together_and_only_subjects_alike_change_places():
    blocks = np.array([3, 3, 0, 1, 1, 2, 4, 4, 4])
    for row in exchanges(blocks, 300, np.random.default_rng(0)).rows:
        assert sorted(row) == list(range(9))
        source = blocks[row]
        for number in np.unique(blocks):
            assert len(set(source[blocks == number])) == 1
        assert set(source[[0, 1, 3, 4]]) == {1, 3}
        assert set(row[6:]) == {6, 7, 8}


@pytest.mark.parametrize(
    ("labels", "blocks"),
    [
        ([0, 0, 1, 1, 1], [0, 1, 2, 3, 4]),
        ([0, 1, 0, 1, 1, 0], [0, 0, 1, 1, 2, 3]),
        ([0, 0, 1, 1, 0, 1], [0, 0, 1, 1, 2, 2]),
        ([0, 1, 2, 0], [0, 1, 2, 3]),
    ],
)
def test_the_count_is_what_the_draws_reach_and_all_are_equally_likely(labels, blocks):
    labels, blocks = np.array(labels), np.array(blocks)
    draws = exchanges(blocks, 20000, np.random.default_rng(1))
    found, times = np.unique(labels[draws.rows], axis=0, return_counts=True)
    assert len(found) == n_exchanges(labels, blocks)
    assert np.allclose(times / 20000, 1 / len(found), atol=5 * np.sqrt(1 / len(found) / 20000))


def test_seeds_repeat():
    blocks = np.array([0, 0, 1, 1, 2])
    a, b, c = (exchanges(blocks, 50, np.random.default_rng(seed)).rows for seed in (4, 4, 5))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_moved_rows_and_signs():
    matrix = np.array([[1.0], [2.0], [3.0]])
    draws = exchanges(np.arange(3), 5, np.random.default_rng(0))
    assert np.array_equal(draws.moved(matrix, 2, 4)[:, :, 0], 1.0 + draws.rows[2:4])
    flips = sign_flips(3, 400, np.random.default_rng(0))
    moved = flips.moved(matrix, 0, 400)[:, :, 0]
    assert np.array_equal(np.abs(moved), np.tile([1.0, 2, 3], (400, 1)))
    assert len(np.unique(moved, axis=0)) == 8
    assert len(flips) == 400


def test_the_smallest_p_value_is_never_zero():
    assert permutation_p(np.array([1.0, np.nan]), np.array([0, 0]), 999)[0] == 0.001
    assert np.isnan(permutation_p(np.array([np.nan]), np.array([0]), 9)[0])
