"""A group optimization that is broken off anywhere continues to the same bits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssmpipe.core.checkpoints import Checkpoints, State
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.result import Result
from ssmpipe.core.spline.evaluate import SplineStack
from tests.support.cohorts import line_bumps
from tests.support.surfaces import bumps

CURVES = EngineOptions(n_coefficients=(8,), landmarks=(41,), barriers=(3.0, 0.1), max_iterations=12)
SURFACES = EngineOptions(n_coefficients=(5, 5), landmarks=(13, 13), barriers=(30.0, 3.0), max_iterations=12)


class BrokenOff(Exception):
    pass


def broken_off(splines: list[Any], options: EngineOptions, at: int, every: int, resume: State | None = None) -> State:
    """Return the last state that was saved before iteration ``at`` was recorded."""
    states: list[State] = []

    def record(row: dict[str, float]) -> None:
        if row["iteration"] == at:
            raise BrokenOff

    def save(state: State) -> None:
        # as a file would: a copy of this moment
        states.append({name: np.array(array) for name, array in state.items()})

    with pytest.raises(BrokenOff):
        optimize_correspondence(splines, options, record=record, checkpoints=Checkpoints(save, every, resume))
    return states[-1]


def bits(result: Result[Optimum]) -> dict[str, bytes]:
    value = result.value
    found = {
        name: getattr(value, name).tobytes()
        for name in ("coefficients", "parameters", "points", "eigenvalues", "guide_residuals")
    }
    found |= {name: column.tobytes() for name, column in result.history.items()}
    found["rest"] = repr(
        (result.status, result.n_iterations, result.n_evaluations, value.description_length, value.certificates)
    ).encode()
    return found


def ignore(_: State) -> None:
    pass


@pytest.mark.parametrize(
    ("splines", "options"),
    [
        (line_bumps(4, tilt=0.05), replace(CURVES, solver="newton")),
        (line_bumps(4, tilt=0.05), CURVES),
        (bumps(4), SURFACES),
        (bumps(3), replace(SURFACES, coarse_to_fine=True, n_coefficients=(6, 6), reference="none")),
        (bumps(3), replace(SURFACES, pose="each-evaluation", pose_rounds=2)),
    ],
    ids=["newton", "curves", "surfaces", "coarse-to-fine", "each-evaluation"],
)
def test_broken_off_and_continued_gives_the_same_bits(splines: list[Any], options: EngineOptions) -> None:
    whole = optimize_correspondence(splines, options)
    n = whole.n_iterations
    assert n > 8
    for at in sorted({3, n // 2, n}):
        state = broken_off(splines, options, at, every=2)
        again: list[dict[str, float]] = []
        result = optimize_correspondence(
            splines, options, record=again.append, checkpoints=Checkpoints(ignore, 2, state)
        )
        assert bits(result) == bits(whole)
        assert again[0]["iteration"] == len(state["history/rows"]) > 0


def test_broken_off_twice() -> None:
    splines = bumps(4)
    whole = optimize_correspondence(splines, SURFACES)
    first = broken_off(splines, SURFACES, 5, every=3)
    second = broken_off(splines, SURFACES, whole.n_iterations - 1, every=3, resume=first)
    assert len(second["history/rows"]) > len(first["history/rows"])
    result = optimize_correspondence(splines, SURFACES, checkpoints=Checkpoints(ignore, 3, second))
    assert bits(result) == bits(whole)


def test_interpolated_guides_are_continued() -> None:
    splines = bumps(3)
    options = replace(SURFACES, n_coefficients=(6, 6), guide_mode="interpolate", pose="keep", normalize="none")
    at = np.array([[[0.5 + 0.02 * k, 0.5]] for k in range(3)])
    guides = [{"top": point} for point in SplineStack(splines).evaluate(at).points[:, 0]]
    whole = optimize_correspondence(splines, options, guides=guides)
    states: list[State] = []
    optimize_correspondence(splines, options, guides=guides, checkpoints=Checkpoints(states.append, 4))
    result = optimize_correspondence(splines, options, guides=guides, checkpoints=Checkpoints(ignore, 4, states[-1]))
    assert bits(result) == bits(whole)
