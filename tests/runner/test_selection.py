from __future__ import annotations

from collections.abc import Callable

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.run_options import RunOptions

Run = Callable[..., RunResult]


def test_selection_problems(run: Run) -> None:
    with pytest.raises(ConfigError, match="no stage 'growth' in this chain; did you mean 'grow'"):
        run(options=RunOptions(first="growth"))
    with pytest.raises(ConfigError, match="no shape 'e'"):
        run(options=RunOptions(shapes=("e",)))
    with pytest.raises(ConfigError, match="group stages need all shapes"):
        run(options=RunOptions(shapes=("a",), only=("total",)))
    with pytest.raises(ConfigError, match="selects no stage"):
        run(options=RunOptions(first="total", last="grow"))
