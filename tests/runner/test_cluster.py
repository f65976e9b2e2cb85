"""What is said before a cluster is asked for anything: config, command line, safety, a missing extra."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.cluster import check_scheduler, is_loopback
from ssmpipe.runner.console import Console
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import run_project
from ssmpipe.runner.run_options import RunOptions

Load = Callable[..., Project]


def test_nothing_unencrypted_leaves_the_machine() -> None:
    for safe in ("local", "slurm", "tcp://127.0.0.1:1", "tcp://localhost:1", "tcp://[::1]:1"):
        check_scheduler(safe, encrypted=False)
    for open_to_others in (
        "tcp://10.0.0.7:8786",
        "tcp://head.cluster:8786",
        "tcp://0.0.0.0:8786",
        "tcp://127.evil.org:1",
    ):
        with pytest.raises(ConfigError, match="not on this machine and not encrypted"):
            check_scheduler(open_to_others, encrypted=True)
    with pytest.raises(ConfigError, match="needs certificates"):
        check_scheduler("tls://head:8786", encrypted=False)
    check_scheduler("tls://head:8786", encrypted=True)
    assert not is_loopback("")


def test_without_the_extra_the_remedy_is_named(project: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    loaded = project(executor="dask")
    with pytest.raises(ConfigError, match=r"distributed, which is not installed; try: pip install 'ssmpipe\[dask\]'"):
        run_project(loaded, RunOptions(), Console(-1))
    assert not loaded.out.exists()


def test_a_local_run_does_not_import_dask(write_config: Callable[..., Path]) -> None:
    code = "import sys, ssmpipe.runner.run, ssmpipe.runner.dask_engine, ssmpipe.runner.cluster; sys.exit('distributed' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
