from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.dry_run import dry_run
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.status import rewrite_report, status_of

CHAIN = ["grow", "shift", "results", "report"]


def test_report_is_written_once_and_again_when_results_change(run: Callable[..., RunResult], tmp_path: Path) -> None:
    result = run(stages=CHAIN)
    page = tmp_path / "out/report.html"
    assert (result.exit_code, result.report) == (0, page)
    text = page.read_text()
    assert "Meshes were scaled by 2" in text
    assert "<script" in text
    again = run(stages=CHAIN)
    assert (again.n_run, again.report, again.exit_code) == (0, page, 0)
    failed = run("stages.grow.refuse=[b]", stages=CHAIN)
    assert failed.exit_code == 3
    assert "the mesh has 2 components" in page.read_text()
    page.unlink()
    assert run("stages.grow.refuse=[b]", stages=CHAIN).n_run == 1
    assert page.exists()


def test_every_shape_has_a_page_and_only_what_changed_is_written(run: Callable[..., RunResult], tmp_path: Path) -> None:
    run("stages.grow.refuse=[b]", stages=CHAIN)
    pages = {path.stem: path for path in (tmp_path / "out/report").iterdir()}
    assert sorted(pages) == ["a", "b", "c", "d"]
    assert "the mesh has 2 components" in pages["b"].read_text()
    assert "set aside" not in pages["a"].read_text()
    stamps = {name: path.stat().st_mtime_ns for name, path in pages.items()}
    text = pages["c"].read_text()
    pages["c"].write_text("spoilt")
    assert run("stages.grow.refuse=[b]", stages=CHAIN).n_run == 1
    assert pages["c"].read_text() == text
    assert [name for name, path in pages.items() if path.stat().st_mtime_ns != stamps[name]] == ["c"]
    (tmp_path / "scans/d.ply").unlink()
    run("stages.grow.refuse=[b]", "min_shapes=2", stages=CHAIN)
    assert sorted(path.stem for path in (tmp_path / "out/report").iterdir()) == ["a", "b", "c"]


def test_report_command(run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path) -> None:
    with pytest.raises(SsmpipeError, match="'correspondence' of stage 'results' has not been made yet"):
        rewrite_report(project(stages=CHAIN))
    run(stages=CHAIN)
    page = tmp_path / "out/report.html"
    text = page.read_text()
    page.write_text("spoilt")
    assert rewrite_report(project(stages=CHAIN)) == page
    assert page.read_text() == text
    assert run(stages=CHAIN).n_run == 0
    assert run(stages=CHAIN, options=RunOptions(only=("report",), forced=frozenset({"*"}))).n_run == 1


def test_dry_run_knows_whether_the_report_is_up_to_date(
    run: Callable[..., RunResult], project: Callable[..., Project]
) -> None:
    def last(*overrides: str, **options: Any) -> tuple[str, bool, str]:
        item = dry_run(project(*overrides, stages=CHAIN), RunOptions(**options))[-1]
        return item.step, item.run, item.reason

    assert last() == ("report", True, "first run")
    run(stages=CHAIN)
    assert last() == ("report", False, "up to date")
    assert last(forced=frozenset({"report"})) == ("report", True, "forced")
    assert last("min_shapes=2") == ("report", True, "input changed: record")
    step, runs, reason = last("stages.grow.factor=3")
    assert (step, runs) == ("report", True)
    assert reason.startswith("input may change: "), reason


def test_status_tells_whether_the_report_is_up_to_date(
    run: Callable[..., RunResult], project: Callable[..., Project]
) -> None:
    def last(*overrides: str) -> tuple[str, str]:
        task = status_of(project(*overrides, stages=CHAIN))[-1]
        return task.step, task.state

    assert last() == ("report", "to do")
    run(stages=CHAIN)
    assert last() == ("report", "done")
    assert last("min_shapes=2") == ("report", "stale")
