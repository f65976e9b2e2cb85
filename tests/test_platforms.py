"""Systems without what only Linux has: every module imports, and a small cohort runs, fails by name and continues."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.runner import batch, disk, execute
from ssmpipe.runner.machine import default_jobs
from tests.support.toys import TOY, scans, write_config  # noqa: F401

ELSEWHERE = """
import platform, signal, sys
sys.modules["resource"] = None
sys.modules["fcntl"] = None
import os
for name in ("sched_getaffinity", "sysconf", "geteuid", "getuid"):
    if hasattr(os, name):
        delattr(os, name)
platform.system = lambda: "Elsewhere"
if hasattr(signal, "pthread_sigmask"):
    del signal.pthread_sigmask
"""
IMPORT_ALL = """
import importlib, pkgutil, sys, ssmpipe
assert sys.modules["resource"] is None
names = [m.name for m in pkgutil.walk_packages(ssmpipe.__path__, "ssmpipe.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(len(names))
"""


@pytest.fixture
def elsewhere(tmp_path: Path) -> dict[str, str]:
    """Environment of a Python that believes to run on a system without these modules; its children do, too."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(ELSEWHERE)
    root = str(Path(__file__).parents[1])
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), root]), "SSMPIPE_STAGES": str(TOY)}


def test_every_module_imports(elsewhere: dict[str, str]) -> None:
    command = [sys.executable, "-W", "ignore", "-c", IMPORT_ALL]
    done = subprocess.run(command, env=elsewhere, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 150


def test_a_cohort_runs_and_a_bad_shape_is_named(
    elsewhere: dict[str, str],
    write_config: Callable[..., Path],  # noqa: F811
) -> None:
    config = write_config(
        stages=[{"grow": {"abort": ["a"]}}, "shift", "total"], limits={"memory_mb": 2000}, max_failed_fraction=0.9
    )
    command = [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-j", "2"]
    done = subprocess.run(command, env=elsewhere, capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("children run without limits.memory_mb: 2000 (this system has no such limit)") == 1
    failures = json.loads((config.parent / "out/failures.json").read_text())
    assert list(failures) == ["a"]
    assert (config.parent / "out/cohort").is_dir()


@pytest.mark.slow
def test_children_end_with_their_parent(
    elsewhere: dict[str, str],
    write_config: Callable[..., Path],  # noqa: F811
    tmp_path: Path,
) -> None:
    config = write_config(stages=[{"grow": {"hang": ["a", "b", "c", "d"]}}, "total"])
    mark = f"--marker-{tmp_path.name}"
    command = [sys.executable, "-m", "ssmpipe.cli", "run", str(config), "-q", "-j", "2"]
    process = subprocess.Popen(command, env={**elsewhere, "MARK": mark})
    if not Path("/proc").is_dir():
        process.kill()
        pytest.skip("children are counted in /proc")

    def alive() -> int:
        found = 0
        for place in Path("/proc").iterdir():
            try:
                found += place.name.isdigit() and f"MARK={mark}".encode() in (place / "environ").read_bytes()
            except OSError:
                continue
        return found

    deadline = time.monotonic() + 60
    while alive() < 3 and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(2)
    assert alive() >= 3, "a parent and two children"
    process.kill()
    process.wait()
    while alive() and time.monotonic() < deadline + 30:
        time.sleep(0.2)
    assert alive() == 0


def test_windows_has_no_tracker_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = pytest.importorskip("multiprocessing.resource_tracker")
    started: list[str | None] = []
    monkeypatch.setattr(tracker, "ensure_running", lambda: started.append(os.environ["PYTHONWARNINGS"]))
    monkeypatch.setenv("PYTHONWARNINGS", "error")
    batch.quiet_tracker()
    assert started == ["error,ignore:resource_tracker:UserWarning"]
    assert os.environ["PYTHONWARNINGS"] == "error"
    monkeypatch.setattr(sys, "platform", "win32")
    batch.quiet_tracker()
    assert len(started) == 1


def test_what_a_system_does_not_tell_is_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert default_jobs() == 3
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert default_jobs() == 1
    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setattr(execute, "Path", lambda text: tmp_path / "nothing" / text.lstrip("/"))
    assert execute.peak_rss_mb() is None
    execute._reset_peak()
    pool = batch.Batch(1, tmp_path)
    monkeypatch.setattr(batch, "Path", lambda text: tmp_path / "nothing" / text.lstrip("/"))
    monkeypatch.delattr(os, "sysconf", raising=False)
    pool._watch_memory()
    assert pool.peak_rss_mb == 0
    assert batch.limit_memory(1000).endswith("(this system has no such limit); watch the memory, or use fewer --jobs")
    assert batch._exit_text(-9999) == "signal 9999"
    assert batch._exit_text(0xC0000005) == "exit code 3221225477"  # how Windows names an access violation
    monkeypatch.delattr(signal, "pthread_sigmask", raising=False)
    with batch.interrupts_for_parent():
        pass


def test_a_folder_is_not_flushed_where_it_cannot_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    flushed = []
    monkeypatch.setattr(disk, "_WINDOWS", True)
    monkeypatch.setattr(os, "fsync", flushed.append)
    disk.flush(tmp_path)
    assert flushed == []
    disk.flush(tmp_path / "file")
    assert len(flushed) == 1
