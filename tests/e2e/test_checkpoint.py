"""A group optimization that is killed half-done is continued by the next run, to the same bytes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmpipe.core.checkpoints import State
from ssmpipe.io.splines import write_spline
from ssmpipe.runner.batch import Job, run_job
from ssmpipe.runner.checkpoint import FOLDER, CheckpointFile
from ssmpipe.runner.console import Console
from ssmpipe.runner.manifest import Request
from ssmpipe.runner.project import Project, load_project
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.run import run_project
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.workspace import make_workspace
from tests.support.cohorts import line_bumps
from tests.support.surfaces import bumps

VERSIONS = {"numpy": "2.0", "scipy": "1.0", "trimesh": "5"}
Load = Callable[..., Project]


def results(out: Path) -> dict[str, bytes]:
    skip = ("timing.json", "history.csv")
    found = {
        str(p.relative_to(out)): p.read_bytes()
        for p in sorted((out / "cohort").rglob("*"))
        if p.is_file() and p.name not in skip
    }
    rows = (out / "cohort/optimize/history.csv").read_text().splitlines()
    at = rows[1].split(",").index("elapsed_s")
    found["history"] = "\n".join(",".join(w for k, w in enumerate(r.split(",")) if k != at) for r in rows[1:]).encode()
    times = [float(row.split(",")[at]) for row in rows[2:]]
    assert times == sorted(times)
    return found


@pytest.fixture
def curves(tmp_path: Path) -> Load:
    (tmp_path / "scans").mkdir()
    for k, curve in enumerate(line_bumps(4, tilt=0.05)):
        write_spline(tmp_path / f"scans/c{k}.npz", curve)

    def load(out: str, **options: Any) -> Project:
        chosen = {"n_coefficients": [8], "landmarks": [41], "max_iterations": 8, **options}
        text = (
            f"name: half\ninput: {{scans: scans/*.npz, units: none}}\noutput: {out}\nstages:\n  - optimize: {chosen}\n"
        )
        (tmp_path / "half.yaml").write_text(text + "limits: {checkpoint_every: 2}\n")
        return load_project(tmp_path / "half.yaml", (), Registry.default())

    return load


def break_off(project: Project, monkeypatch: pytest.MonkeyPatch, n_saves: int) -> None:
    """Run the optimization in this process until its state was saved so many times."""
    workspace = make_workspace(project)
    workspace.scratch.mkdir(parents=True, exist_ok=True)
    job = Job(workspace, ("optimize",), None, tuple(sorted(project.sources)), checkpoint_every=2)
    whole, count = CheckpointFile.save, [0]

    def save(self: CheckpointFile, state: State) -> None:
        whole(self, state)
        count[0] += 1
        if count[0] == n_saves:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointFile, "save", save)
        with pytest.raises(KeyboardInterrupt):
            run_job(job, workspace.scratch / "events", None)
    assert (project.out / FOLDER / "optimize.npz").is_file()
    assert not (project.out / "cohort/optimize").exists()


def test_the_next_run_continues(
    curves: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = curves("whole")
    assert run_project(whole, RunOptions(jobs=1), Console(-1)).exit_code == 0
    assert not (whole.out / FOLDER).exists()
    half = curves("half")
    for _ in range(2):
        break_off(half, monkeypatch, 3)
    (half.out / FOLDER / ".optimize.npz.77").write_text("what a kill leaves")
    assert run_project(half, RunOptions(jobs=1), Console(0)).exit_code == 0
    # each of the two runs saved three states, two iterations apart; the last of a round is not saved
    said = re.search(r"optimize: continues from the checkpoint at iteration (\d+)", capsys.readouterr().out)
    assert said is not None
    assert 12 <= int(said[1]) <= 16
    assert results(half.out) == results(whole.out)
    assert not (half.out / FOLDER).exists()


def test_without_checkpoints_nothing_is_continued_or_said_to_be(
    curves: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    break_off(curves("half"), monkeypatch, 2)
    config = curves("half").path
    config.write_text(config.read_text().replace("checkpoint_every: 2", "checkpoint_every: null"))
    project = load_project(config, (), Registry.default())
    assert run_project(project, RunOptions(jobs=1), Console(0)).exit_code == 0
    assert "checkpoint" not in capsys.readouterr().out
    assert "checkpoint" not in json.loads((project.out / "cohort/optimize/timing.json").read_text())
    assert not (project.out / FOLDER).exists()


def test_a_changed_option_discards_it_and_says_why(
    curves: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    break_off(curves("half"), monkeypatch, 2)
    project = curves("half", prior=0.5)
    assert run_project(project, RunOptions(jobs=1), Console(0)).exit_code == 0
    assert "optimize: checkpoint discarded: config changed: prior" in capsys.readouterr().out
    fresh = curves("fresh", prior=0.5)
    run_project(fresh, RunOptions(jobs=1), Console(-1))
    assert results(project.out) == results(fresh.out)


def test_what_makes_a_state_useless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    request = Request("optimize", 7, {"prior": 0.1}, {"surface": "abc"}, 0)

    def discarded(other: Request, versions: dict[str, str] = VERSIONS, *, force: bool = False) -> str:
        found = CheckpointFile(tmp_path, "optimize", other, versions).find(force=force)
        assert found.state is None
        return found.discarded

    file = CheckpointFile(tmp_path, "optimize", request, VERSIONS)
    assert file.find().line == ""
    file.save({"history/rows": np.zeros((8, 4)), "x": np.arange(3.0)})
    found = file.find()
    assert found.line == "continues from the checkpoint at iteration 7"
    assert found.state is not None
    np.testing.assert_array_equal(found.state["x"], np.arange(3.0))
    assert discarded(request, force=True) == "forced"
    assert discarded(Request("optimize", 8, {"prior": 0.1}, {"surface": "abc"}, 0)) == "stage version changed: 7 -> 8"
    assert discarded(Request("optimize", 7, {"prior": 0.2}, {"surface": "abc"}, 0)) == "config changed: prior"
    assert discarded(Request("optimize", 7, {"prior": 0.1}, {"surface": "x"}, 0)) == "input changed: surface"
    assert discarded(request, {**VERSIONS, "numpy": "3.0"}) == "numpy changed: 2.0 -> 3.0"
    monkeypatch.setattr("ssmpipe.runner.checkpoint.LAYOUT", 99)
    assert "layout" in discarded(request)
    file.path.write_bytes(file.path.read_bytes()[:100])
    assert discarded(request).startswith("it cannot be read")
    file.remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_kill_nine_in_the_optimization(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k, surface in enumerate(bumps(6)):
        write_spline(tmp_path / f"scans/s{k}.npz", surface)
    config = tmp_path / "kill.yaml"
    config.write_text(
        "name: kill\ninput: {scans: scans/*.npz}\noutput: whole\nlimits: {checkpoint_every: 3}\nstages:\n"
        "  - optimize: {n_coefficients: [7, 7], landmarks: [41, 41], barriers: [30.0, 3.0, 0.1], max_iterations: 40,"
        " relative_decrease: 1.0e-9, pose_rounds: 2}\n"
    )
    command = [sys.executable, "-m", "ssmpipe", "run", str(config), "-j", "1"]
    subprocess.run([*command, "-q"], check=True, timeout=300)
    command += ["--set", f"output={tmp_path / 'killed'}"]
    state = tmp_path / "killed" / FOLDER / "optimize.npz"
    continued = 0
    for _ in range(3):
        before = state.stat().st_ino if state.exists() else 0
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:
            if state.exists() and state.stat().st_ino != before:
                break
            time.sleep(0.005)
        assert process.poll() is None, "the optimization ended before its state was saved"
        os.kill(process.pid, signal.SIGKILL)
        out, _ = process.communicate(timeout=60)
        continued += "continues from the checkpoint" in out
    done = subprocess.run(command, check=True, timeout=300, capture_output=True, text=True)
    assert "continues from the checkpoint" in done.stdout
    assert continued == 2
    assert results(tmp_path / "killed") == results(tmp_path / "whole")
    assert not state.parent.exists()
