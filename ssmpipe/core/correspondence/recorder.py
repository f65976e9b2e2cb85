"""The history of a group optimization: a row for every accepted step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.journal import Journal
from ssmpipe.core.correspondence.objective import GroupObjective


class Recorder:
    """Collects the history rows and hands each one on.

    Parameters
    ----------
    record : callable, optional
        Gets every row: ``iteration, description_length, max_constraint, min_jacobian``.
    journal : Journal
        Of the descents; holds the rows, those of an earlier run at first.

    Attributes
    ----------
    n_iterations, n_evaluations : int
        Of all descents so far; whoever descends adds to them.
    """

    def __init__(self, record: Callable[[dict[str, float]], None] | None, journal: Journal) -> None:
        self._record = record
        self.journal = journal
        self._rows = journal.rows
        self.n_iterations = 0
        self.n_evaluations = 0

    def start(self, objective: GroupObjective, x: Floats) -> None:
        """Note the state before the first iteration of all."""
        if not self._rows:
            self._note(objective, x)

    def note_iteration(self, objective: GroupObjective, _k: int, x: Floats, _f: float, _g: Floats) -> None:
        """Note an accepted step."""
        self._note(objective, x)

    def _note(self, objective: GroupObjective, x: Floats) -> None:
        jacobians = objective.jacobians(x)
        row = {
            "iteration": float(len(self._rows)),
            "description_length": objective.spectral_value(x),
            "max_constraint": float(objective.constraint.constraint(jacobians).max()),
            "min_jacobian": float(jacobians.min()),
        }
        self._rows.append(row)
        if self._record is not None:
            self._record(row)

    def history(self) -> dict[str, Floats]:
        """Return the columns."""
        return {key: np.array([row[key] for row in self._rows]) for key in self._rows[0]}
