from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.turns import starting_turns
from tests.support.surfaces import wrapped, wrapped_samples

HEIGHTS = (1.0, 0.7, 1.2, 1.4)


@pytest.mark.parametrize("kind", ["tube", "cone", "closed"])
@pytest.mark.parametrize("seed", [0, 1])
def test_turned_shapes_are_turned_back_before_and_by_the_descent(kind: str, seed: int) -> None:
    phases = np.random.default_rng(seed).uniform(-0.4, 0.4, 4)
    surfaces = [wrapped(kind, n=16, phase=p, bump=b) for p, b in zip(phases, HEIGHTS, strict=True)]
    options = EngineOptions(
        n_coefficients=(6, 6), landmarks=(15, 15), boundary="periodic", pose="keep", normalize="none", reference=0
    )
    optimum = optimize_correspondence(surfaces, options).value
    field = optimum.parameters.reshape(4, 15, 15, 2)
    found = (field[..., 0] - (np.arange(15) / 15)[None, :, None])[:, :, 3:-3].mean(axis=(1, 2))
    wanted = (phases[0] - phases + 0.5) % 1.0 - 0.5
    assert (found - wanted + 0.5) % 1.0 - 0.5 == pytest.approx(np.zeros(4), abs=2e-3)
    assert all(c.verdict == "proved" for c in optimum.certificates)


@pytest.mark.parametrize("kind", ["tube", "closed"])
def test_an_affine_start_begins_turned_too(kind: str) -> None:
    # else the affine map takes the turn of the parameters for one of the shape
    phases = np.array([0.0, 0.2, -0.3, 0.4])
    surfaces = [wrapped(kind, n=16, phase=p, bump=b) for p, b in zip(phases, HEIGHTS, strict=True)]
    options = EngineOptions(
        n_coefficients=(6, 6), landmarks=(20, 15), boundary="periodic", pose="keep", reference=0, start="affine"
    )
    optimum = optimize_correspondence(surfaces, options).value
    field = optimum.parameters.reshape(4, 20, 15, 2)
    found = (field[..., 0] - (np.arange(20) / 20)[None, :, None])[:, :, 3:-3].mean(axis=(1, 2))
    assert (found + phases + 0.5) % 1.0 - 0.5 == pytest.approx(np.zeros(4), abs=2e-3)
    assert all(c.verdict == "proved" for c in optimum.certificates)


def test_small_turns_and_turns_without_gain_are_left() -> None:
    plain = np.array([wrapped_samples("tube", 40, phase=p)[:, ::4] for p in (0.0, 0.03)])
    assert starting_turns(plain[:, :-1]).tolist() == [0.0, 0.0]
    angle = 2 * np.pi * np.arange(40) / 40
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    other = np.array([circle, circle + 1e-3 * np.cos(5 * angle)[:, None, None]])
    assert starting_turns(other).tolist() == [0.0, 0.0]


def test_the_turn_goes_the_right_way() -> None:
    tubes = np.array([wrapped_samples("tube", 41, phase=p)[:-1] for p in (0.0, 0.25, -0.375)])
    assert starting_turns(tubes) == pytest.approx([0.0, -0.25, 0.375])
