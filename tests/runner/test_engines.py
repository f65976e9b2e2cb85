"""A group optimization has the same bits on every engine, also when one of its processes is killed."""

from __future__ import annotations

import threading
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.process_engine import ProcessEngine
from ssmpipe.core import blocks
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.rows import LandmarkRows, RowSums, _described, automatic_blocks, grams
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.runner.dask_engine import DaskEngine, EngineError
from ssmpipe.runner.shared_folder import SharedFolder
from tests.support.engines import OPTIONS, Killing, optimized
from tests.support.surfaces import bumps


@pytest.mark.parametrize("normals", [0.0, 0.8])
def test_serial_and_processes_give_the_same_bits_also_when_one_is_killed(tmp_path: Path, normals: float) -> None:
    options = replace(OPTIONS, normals=normals)
    serial = optimized(None, options)
    with ProcessEngine(2, tmp_path / "shared") as engine:
        killing = Killing(engine, lambda: engine.pids, after=7)
        assert optimized(killing, options) == serial
        assert killing.n_killed == 1
        assert engine.bytes_moved > 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("n_blocks", "normals"), [(None, 0.0), (4, 0.8)])
def test_threads_share_the_work_and_give_the_same_bits(
    monkeypatch: pytest.MonkeyPatch, n_blocks: int | None, normals: float
) -> None:
    options = replace(OPTIONS, landmark_blocks=n_blocks, normals=normals)
    serial = optimized(None, options)
    used: set[int] = set()
    stack = SplineStack.evaluate_some
    second = threading.Event()

    def watched(self: SplineStack, *arguments: Any) -> Any:
        used.add(threading.get_ident())
        if len(used) > 1:
            second.set()
        if getattr(blocks._HERE, "in_block", False):
            second.wait(30)  # the first thread leaves blocks to others, however slowly they wake
        return stack(self, *arguments)

    monkeypatch.setattr(SplineStack, "evaluate_some", watched)
    assert optimized(None, options, threads=3) == serial
    assert len(used) == 1, "five shapes are too few"
    monkeypatch.setattr("ssmpipe.core.correspondence.optimize.THREADS_FROM", 5)
    monkeypatch.setattr("ssmpipe.core.spline.evaluate._POINTS_PER_BLOCK", 1)
    assert optimized(None, options, threads=3) == serial
    assert len(used) > 1


@pytest.mark.slow
def test_any_number_of_processes(tmp_path: Path) -> None:
    serial = optimized(None)
    for n in (3, 5):
        with ProcessEngine(n, tmp_path / "shared") as engine:
            assert optimized(engine) == serial


def test_blocks_change_the_last_digits_only() -> None:
    splines = bumps(5)
    space = Reparameterization((5, 6), (21, 17))
    stack = SplineStack(splines)
    weights = np.full(21 * 17, 1 / (21 * 17))
    function = spectral_function("description-length", 1e-3)
    start = GroupObjective(stack, space, function, reference=0).start()
    x = start + 0.01 * np.random.default_rng(1).normal(size=start.size)
    found = []
    for n_blocks in (0, 1, 4, 21, 50):
        sums = RowSums(splines, stack, space, weights, n_blocks) if n_blocks else None
        objective = GroupObjective(stack, space, function, base_weights=weights, reference=0, sums=sums)
        found.append((*objective.spectral_gradient(x), objective.spectral_value(x)))
        assert found[-1][0] == found[-1][2]
    for value, gradient, _ in found[1:]:
        assert value == pytest.approx(found[0][0], rel=1e-12)
        np.testing.assert_allclose(gradient, found[0][1], rtol=1e-9, atol=1e-10 * np.abs(gradient).max())


def test_a_small_cohort_is_not_parted_and_options_that_cannot_be_are_evaluated_here() -> None:
    assert automatic_blocks(63) == 1
    assert automatic_blocks(64) == 4
    one, unparted = (optimized(None, replace(OPTIONS, landmark_blocks=n)) for n in (1, None))
    assert one == unparted
    second = replace(OPTIONS, covariance="II", max_iterations=2)
    assert optimized(None, second) == optimized(None, replace(second, landmark_blocks=1))


def test_a_call_that_is_made_again_while_it_runs_waits_for_the_memory_of_the_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splines, space = bumps(3), Reparameterization((5, 5), (9, 9))
    weights = np.full(81, 1 / 81)
    content = SharedFolder(tmp_path / "shared").share(_described(splines, SplineStack(splines), space, weights))
    unknowns = np.tile(space.identity()[space.free], (3, 1))
    inside, most, both = [0], [0], threading.Barrier(2)
    gram = LandmarkRows.gram

    def watched(self: LandmarkRows, coefficients: Floats) -> Floats:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        with suppress(threading.BrokenBarrierError):
            both.wait(0.3)  # the other call comes in here if it may
        out = gram(self, coefficients)
        inside[0] -= 1
        return out

    monkeypatch.setattr(LandmarkRows, "gram", watched)
    threads = [threading.Thread(target=grams, args=(content, ((0, 9),), unknowns)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]


def _die() -> None:
    import os

    os._exit(3)


def _refuse() -> None:
    raise ValueError("no")


def _refuse_first(k: int) -> int:
    if k == 0:
        raise ValueError("no")
    return k


def test_answers_of_a_call_that_failed_are_not_taken_for_those_of_the_next(tmp_path: Path) -> None:
    with ProcessEngine(2, tmp_path / "shared") as engine:
        with pytest.raises(ValueError, match="no"):
            engine.call(_refuse_first, [(0,), (1,)])
        assert engine.call(_refuse_first, [(2,), (3,)]) == [2, 3]


def test_a_function_that_always_kills_its_process_is_an_error_and_one_that_raises_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.process_engine.RETRIES", 1)
    with ProcessEngine(1, tmp_path / "shared") as engine:
        with pytest.raises(EngineError, match="died 2 times"):
            engine.call(_die, [()])
        with pytest.raises(ValueError, match="no"):
            engine.call(_refuse, [()])


class Answer:
    """What an actor, or a task, brings: its outcomes in turn."""

    def __init__(self, *outcomes: Any) -> None:
        self._outcomes = iter(outcomes)

    def done(self) -> bool:
        return not self.waits

    def result(self, timeout: float | None = None) -> Any:
        found = next(self._outcomes)
        self.waits = isinstance(found, TimeoutError)
        if isinstance(found, Exception):
            raise found
        return found


def test_a_worker_whose_answer_cannot_be_read_is_not_taken_for_gone(tmp_path: Path) -> None:
    """The other call that it has is still waited for, and it gets the next ones."""
    pytest.importorskip("distributed")

    class Actor:
        answers = iter([Answer(ValueError("cannot be read")), Answer(TimeoutError(), (True, 2)), Answer((True, 3))])

        def call(self, function: Any, args: Any) -> Answer:
            return next(self.answers)

        def alive(self) -> Answer:
            return Answer(None)

    class Client:
        status = "running"

        def nthreads(self) -> dict[str, int]:
            return {"tcp://here": 1}

        def as_current(self) -> Any:
            return nullcontext()

        def submit(self, function: Any, *args: Any, actor: bool = False, **rest: Any) -> Answer:
            return Answer(Actor() if actor else 1)

    engine = DaskEngine(Client(), tmp_path / "shared")
    assert engine.call(min, [(), ()]) == [1, 2]
    assert engine.n_tasks == 1
    assert engine.call(min, [()]) == [3]
    assert engine.n_tasks == 1
