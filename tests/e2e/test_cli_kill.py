"""Runs that are killed at random moments leave no half output, and the next run ends as if nothing had happened."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.toys import TOY


def data(out: Path) -> dict[str, bytes]:
    skip = ("timing.json", "run.json", "history.csv")
    return {
        str(p.relative_to(out)): p.read_bytes()
        for folder in ("shapes", "cohort")
        for p in sorted((out / folder).rglob("*"))
        if p.is_file() and p.name not in skip
    }


def test_a_killed_run_leaves_no_chatter_behind(write_config: Callable[..., Path]) -> None:
    config = write_config(stages=[{"grow": {"hang": ["a"]}}, "total"])
    out = config.parent / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-q", "-j", "2"],
        env={**os.environ, "SSMPIPE_STAGES": str(TOY)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not (out / "shapes/d/01-grow").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    assert process.communicate(timeout=60)[1] == ""  # ends with the last process that could say something


@pytest.mark.parametrize("n_kills", [4, pytest.param(60, marks=pytest.mark.slow)])
def test_kill_at_random_moments(n_kills: int, write_config: Callable[..., Path]) -> None:
    config = write_config(stages=["grow", {"shift": {"noise": 0.1}}, "total"])
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    command = [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-q", "-j", "2"]
    out = config.parent / "out"
    subprocess.run(command, env=env, check=True)
    clean = data(out)
    shutil.rmtree(out)
    rng = random.Random(0)
    for k in range(n_kills):
        process = subprocess.Popen(command, env=env)
        time.sleep(rng.uniform(0.3, 1.2))
        process.kill()
        process.wait()
        for folder in (*out.glob("shapes/*/*"), *out.glob("cohort/*")):
            assert (folder / "manifest.json").is_file(), folder
        if k % 4 == 0:
            shutil.rmtree(out / "cohort", ignore_errors=True)
            shutil.rmtree(out / "shapes" / rng.choice("abcd"), ignore_errors=True)
    subprocess.run(command, env=env, check=True)
    assert data(out) == clean
