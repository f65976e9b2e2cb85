from __future__ import annotations

from collections.abc import Callable

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.project import Project
from ssmpipe.runner.run_options import RunOptions, scheduler_of

Load = Callable[..., Project]
SLURM = {"slurm": {"queue": "long", "cores": 8, "memory": "32GB", "walltime": "02:00:00"}}


@pytest.mark.parametrize(
    ("changes", "options", "expected"),
    [
        ({}, RunOptions(), None),
        ({"scheduler": "tcp://127.0.0.1:8786"}, RunOptions(), None),
        ({"executor": "dask"}, RunOptions(), "local"),
        ({"executor": "dask", "scheduler": SLURM}, RunOptions(), "slurm"),
        ({"executor": "dask", "scheduler": SLURM}, RunOptions(executor="local"), None),
        ({"executor": "dask", "scheduler": SLURM}, RunOptions(scheduler="local"), "local"),
        ({}, RunOptions(executor="dask", scheduler="tls://head:8786"), "tls://head:8786"),
    ],
)
def test_the_command_line_comes_before_the_config(
    project: Load, changes: dict[str, object], options: RunOptions, expected: str | None
) -> None:
    assert scheduler_of(project(**changes).config, options) == expected


def test_bad_addresses_are_refused(project: Load) -> None:
    with pytest.raises(ConfigError, match="'http://x' is not local, slurm, tcp://HOST:PORT or tls://HOST:PORT"):
        project(executor="dask", scheduler="http://x")
    config = project(executor="dask").config
    with pytest.raises(ConfigError, match="--scheduler: 'head' is not local"):
        scheduler_of(config, RunOptions(scheduler="head"))
    with pytest.raises(ConfigError, match="add --executor dask"):
        scheduler_of(project().config, RunOptions(scheduler="local"))
    with pytest.raises(ConfigError, match="cores"):
        project(executor="dask", scheduler={"slurm": {"queue": "long", "memory": "1GB", "walltime": "01:00:00"}})
