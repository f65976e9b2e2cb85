from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.evaluation.measures import generalization
from ssmpipe.core.evaluation.reconstruction import leave_one_out_reconstructions

RNG = np.random.default_rng(4)
SHAPES = RNG.standard_normal((6, 20, 3)) * np.linspace(1, 3, 20)[:, None] + 5


@pytest.mark.parametrize("n_modes", [1, 2, 4])
def test_the_distances_are_the_generalization_of_the_model(n_modes: int) -> None:
    made = leave_one_out_reconstructions(SHAPES, n_modes)
    rms = np.sqrt(((made - SHAPES) ** 2).sum(axis=2).mean(axis=1))
    assert rms.mean() == pytest.approx(generalization(SHAPES, 4)[0][n_modes - 1], rel=1e-9)


def test_without_modes_it_is_the_mean_of_the_others() -> None:
    made = leave_one_out_reconstructions(SHAPES, 0)
    for k in range(len(SHAPES)):
        np.testing.assert_allclose(made[k], np.delete(SHAPES, k, axis=0).mean(axis=0), atol=1e-12)


def test_shapes_in_the_span_of_the_others_come_back_exactly() -> None:
    weights = RNG.standard_normal((7, 2))
    flat = SHAPES[0] + np.einsum("sm,mpd->spd", weights, SHAPES[1:3])
    np.testing.assert_allclose(leave_one_out_reconstructions(flat), flat, atol=1e-9)


def test_the_left_out_shape_is_really_left_out() -> None:
    spoilt = SHAPES.copy()
    spoilt[2] += 100 * RNG.standard_normal(spoilt[2].shape)
    off = np.linalg.norm(leave_one_out_reconstructions(spoilt) - spoilt, axis=2).mean(axis=1)
    assert off[2] > 50
