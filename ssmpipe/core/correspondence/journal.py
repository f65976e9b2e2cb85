"""The descents of a group optimization in their order: finished ones are not made again, a half-done one is continued.

What lies between two descents (poses, normalization, refinement of the maps) is computed again from their results; it is cheap and
gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.checkpoints import Checkpoints, under, within
from ssmpipe.core.optim.interior import DescentOptions, InteriorProblem, minimize_interior
from ssmpipe.core.optim.state import DescentState
from ssmpipe.core.result import Result, Status

_STATUSES: tuple[Status, ...] = get_args(Status)
Row = dict[str, float]


class Journal:
    """Runs descents, saves their state, and replays what an earlier run has done.

    Parameters
    ----------
    checkpoints : Checkpoints, optional

    Attributes
    ----------
    rows : list of dict
        History so far; those of an earlier run at first. Whoever records iterations appends to it.
    """

    def __init__(self, checkpoints: Checkpoints | None = None) -> None:
        self._checkpoints = checkpoints
        self._finished: list[Result[Floats]] = []
        self._earlier: list[Result[Floats]] = []
        self._half_done: DescentState | None = None
        self.rows: list[Row] = []
        state = checkpoints.resume if checkpoints is not None else None
        if state is None:
            return
        columns = [str(name) for name in state["history/columns"]]
        self.rows = [dict(zip(columns, map(float, row), strict=True)) for row in state["history/rows"]]
        for k in range(int(state["n_finished"])):
            one = within(state, f"finished/{k}")
            status, n_iterations, n_evaluations = (int(c) for c in one["counts"])
            self._earlier.append(Result(one["x"], _STATUSES[status], n_iterations, n_evaluations, {}))
        self._half_done = DescentState.of(within(state, "descent"))

    def descend(
        self,
        problem: InteriorProblem,
        x: Floats,
        options: DescentOptions,
        callback: Callable[[int, Floats, float, Floats], None],
    ) -> Result[Floats]:
        """Minimize, or take over what is known about this descent, the next one in the order."""
        k = len(self._finished)
        if k < len(self._earlier):
            result = self._earlier[k]
        else:
            resume, self._half_done = self._half_done, None
            save = self._save if self._checkpoints is not None else None
            result = minimize_interior(problem, x, options, callback=callback, resume=resume, checkpoint=save)
        self._finished.append(result)
        return result

    def _save(self, descent: DescentState) -> None:
        assert self._checkpoints is not None
        if (len(self.rows) - 1) % self._checkpoints.every:
            return
        columns = list(self.rows[0])
        state = {
            "history/columns": np.array(columns),
            "history/rows": np.array([[row[c] for c in columns] for row in self.rows]),
            "n_finished": np.array(len(self._finished)),
            **under(descent.arrays(), "descent"),
        }
        for k, one in enumerate(self._finished):
            counts = np.array([_STATUSES.index(one.status), one.n_iterations, one.n_evaluations])
            state |= under({"x": one.value, "counts": counts}, f"finished/{k}")
        self._checkpoints.save(state)
