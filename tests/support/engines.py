"""A cohort of curves whose optimization is shared by processes, and an engine whose processes are killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from typing import Any

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.engine import Arrays, Content, Engine
from ssmpipe.core.result import Result
from tests.support.surfaces import bumps

OPTIONS = EngineOptions(
    n_coefficients=(5, 6), landmarks=(21, 17), barriers=(10.0,), max_iterations=6, pose_rounds=1, landmark_blocks=4
)


def optimized(engine: Engine | None, options: EngineOptions = OPTIONS, threads: int = 1) -> dict[str, bytes]:
    """Return the bits of a small optimization."""
    result: Result[Optimum] = optimize_correspondence(bumps(5), options, engine=engine, threads=threads)
    value = result.value
    found = {name: getattr(value, name).tobytes() for name in ("coefficients", "points", "eigenvalues")}
    found |= {name: column.tobytes() for name, column in result.history.items()}
    return found | {"rest": repr((result.n_evaluations, value.description_length, value.certificates)).encode()}


class Killing:
    """An engine that kills one of its processes after some calls."""

    def __init__(self, engine: Any, pids: Callable[[], Sequence[int]], after: int) -> None:
        self.engine, self.pids, self.left = engine, pids, after
        self.n_killed = 0

    @property
    def n_workers(self) -> int:
        return int(self.engine.n_workers)

    def share(self, arrays: Arrays) -> Content:
        return self.engine.share(arrays)  # type: ignore[no-any-return]

    def call(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        self.left -= 1
        if self.left == 0:
            os.kill(self.pids()[0], signal.SIGKILL)
            self.n_killed += 1
        return self.engine.call(function, arguments)  # type: ignore[no-any-return]
