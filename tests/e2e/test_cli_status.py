"""What a user is told while a run goes on, and why everything ran or was skipped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.support.toys import TOY

COMMAND = [sys.executable, "-m", "ssmpipe.cli"]


def ssmpipe(*args: object) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    return subprocess.run([*COMMAND, *map(str, args)], env=env, capture_output=True, text=True, check=False)


def test_status_works_while_a_run_holds_the_folder(write_config: Callable[..., Path]) -> None:
    config = write_config(stages=[{"grow": {"hang": ["d"]}}, "shift", "total"], limits={"timeout_s": 100})
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    process = subprocess.Popen([*COMMAND, "run", str(config), "-q", "-j", "2"], env=env)
    try:
        done = config.parent / "out/shapes/c/01-grow/manifest.json"
        for _ in range(600):
            if done.is_file():
                break
            time.sleep(0.1)
        status = ssmpipe("status", config, "--json")
        assert process.poll() is None, "the run must still go on"
        second = ssmpipe("run", config, "-q")
    finally:
        process.kill()
        process.wait()
    assert status.returncode == 0, status.stderr
    found = {(t["step"], t["shape"]): t for t in json.loads(status.stdout)["tasks"]}
    assert found["grow", "c"]["state"] == "done"
    assert found["grow", "d"]["state"] == found["total", ""]["state"] == "to do"
    assert all(task["reason"] for task in found.values())
    assert second.returncode == 75
    assert str(process.pid) in second.stderr


def test_every_task_prints_and_stores_why_it_ran_or_did_not(write_config: Callable[..., Path]) -> None:
    config = write_config()
    first = ssmpipe("run", config, "-vv")
    record = config.parent / "out/run.json"

    def stored() -> set[tuple[str, str, str]]:
        run = json.loads(record.read_text())
        tasks = [(i, t) for i, shape in run["shapes"].items() for t in shape["stages"]]
        tasks += [("cohort", t) for t in run["cohort_stages"]]
        return {(i, t["step"], t["reason"]) for i, t in tasks}

    everything = {(i, step) for i in "abcd" for step in ("grow", "shift")} | {("cohort", "total")}
    assert {(i, step) for i, step, reason in stored() if reason == "first run"} == everything
    again = ssmpipe("run", config, "-vv", "--set", "stages.total.weight=3", "--set", "stages.grow.note=x")
    for i in "abcd":
        assert f"{i} grow: first run" in first.stdout
        assert f"{i} grow: config changed: note" in again.stdout
    assert "shift: 4 of 4 shapes are up to date" in again.stdout
    reasons = {(i, step): reason for i, step, reason in stored()}
    assert reasons["a", "grow"].startswith("config changed: note")
    assert reasons["a", "shift"] == "up to date"
    assert reasons["cohort", "total"].startswith("config changed: weight")
