"""Parts of a run that work at the same time on one folder wait for each other's patients and bring the same bytes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.e2e.test_cli_kill import data
from tests.support.toys import TOY


def test_parts_at_the_same_time(write_config: Callable[..., Path]) -> None:
    config = write_config()
    command = [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-j", "1"]
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    subprocess.run(command, env=env, check=True, capture_output=True)
    clean = data(config.parent / "out")
    shutil.rmtree(config.parent / "out")
    parts = [
        subprocess.Popen([*command, "--part", f"{i}/3"], env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for i in (1, 2, 3)
    ]
    for part in parts:
        said = part.communicate(timeout=120)[0].decode()
        assert part.returncode == 0, said
        assert "Traceback" not in said
    done = data(config.parent / "out")
    assert {name for name in clean if not name.startswith("cohort/total")} == set(done)
    subprocess.run(command, env=env, check=True, capture_output=True)
    assert data(config.parent / "out") == clean
