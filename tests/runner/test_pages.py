from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.errors import ArtifactError
from ssmpipe.runner.batch import Batch, Closing, Failure, Job, Outcome
from ssmpipe.runner.console import Console
from ssmpipe.runner.pages import report_step
from ssmpipe.runner.patients import landmarks_of
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.sources import Source
from ssmpipe.runner.status import rewrite_report
from ssmpipe.runner.workspace import Workspace, make_workspace
from tests.support.small_run import small_run

CHAIN = ["grow", "shift", "results", "report"]


class Told(Console):
    """Keeps warnings."""

    def __init__(self) -> None:
        super().__init__(-1)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def pages(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((out / "report").iterdir())}


def test_pages_do_not_depend_on_the_number_of_children(
    run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path
) -> None:
    run(stages=CHAIN, options=RunOptions(jobs=1))
    alone = pages(tmp_path / "out")
    assert len(alone) == 4
    rewrite_report(project(stages=CHAIN), jobs=3, console=Told())
    assert pages(tmp_path / "out") == alone
    assert not (tmp_path / "out/.work").exists()


def test_a_page_that_cannot_be_made_costs_its_pictures_and_no_more(
    run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path
) -> None:
    run(stages=CHAIN)
    whole = pages(tmp_path / "out")
    mesh = next((tmp_path / "out/shapes/b/01-grow").glob("mesh*"))
    mesh.write_bytes(mesh.read_bytes()[:-40])
    console = Told()
    rewrite_report(project(stages=CHAIN), console=console)
    assert [line.split(":")[0] for line in console.warnings] == ["b, b.ply"]
    assert "its page has no pictures of the stages" in console.warnings[0]
    now = pages(tmp_path / "out")
    assert {name for name in whole if whole[name] != now[name]} == {"b.html"}
    assert b"Patient page" in now["b.html"]
    assert len(now["b.html"]) < len(whole["b.html"])
    assert not (tmp_path / "out/shapes/b/failed.txt").exists()


def test_without_a_page_there_is_no_link_and_the_next_run_tries_again(
    run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(stages=CHAIN)
    out = tmp_path / "out"
    monkeypatch.setattr(Batch, "run", _nothing_of("b", Batch.run))
    console = Told()
    rewrite_report(project(stages=CHAIN), console=console)
    monkeypatch.undo()
    assert console.warnings == ["b, b.ply: its page could not be made: the process crashed"]
    assert "report/a.html" in (out / "report.html").read_text()
    assert "report/b.html" not in (out / "report.html").read_text()
    again = run(stages=CHAIN)
    assert (again.exit_code, again.n_run) == (0, 1)
    assert "report/b.html" in (out / "report.html").read_text()
    assert sorted(pages(out)) == ["a.html", "b.html", "c.html", "d.html"]


def _nothing_of(shape: str, run: Callable[..., None]) -> Callable[..., None]:
    def part(self: Batch, jobs: list[Job], finished: Callable[[Job, Outcome], None]) -> None:
        run(self, [job for job in jobs if job.shape != shape], finished)
        for job in jobs:
            if job.shape == shape:
                finished(job, Outcome((), Failure(shape, "report", f"{shape}.ply", "the process crashed", "")))

    return part


def test_a_changed_landmark_writes_the_page_of_its_shape_again(
    run: Callable[..., RunResult], tmp_path: Path, scans: Path
) -> None:
    marks = {name: {"tip": [10.0 + i + 3 * i, 3.0 * i, 3.0 * i]} for i, name in enumerate("abcd")}
    file = tmp_path / "marks.json"
    file.write_text(json.dumps(marks))
    given = {"stages": ["grow", "results", "report"], "input": {"landmarks": "marks.json"}}  # no stage reads them
    run(**given)
    stamps = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out/report").iterdir()}
    marks["b"]["tip"] = [3.0, 14.0, 3.0]
    file.write_text(json.dumps(marks))
    assert run(**given).n_run == 1
    now = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out/report").iterdir()}
    assert {name for name in stamps if stamps[name] != now[name]} == {"b.html"}


def test_landmarks_are_known_without_reading_the_scan_and_what_is_damaged_is_left_out(
    run: Callable[..., RunResult], project: Callable[..., Project], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "marks.json").write_text(json.dumps({"a": {"tip": [10.0, 0, 0]}, "b": {"tip": [14.0, 3, 3]}}))
    given = {"stages": ["grow", "results", "report"], "input": {"landmarks": "marks.json"}}
    run(**given)
    workspace = make_workspace(project(**given))
    step, correspondence = report_step(workspace), small_run(ids=("a", "b", "c"), n=7, n_modes=2).correspondence

    def refuse(self: Source) -> None:
        raise AssertionError("a scan is read in the parent")

    monkeypatch.setattr(Source, "load", refuse)
    found = landmarks_of(workspace, step, correspondence)
    assert sorted(found) == ["a", "b"]
    np.testing.assert_allclose(found["a"]["tip"], [10, 0, 0])
    console = Told()

    def damaged(self: Source) -> dict[str, object]:
        if self.id == "a":
            raise ArtifactError("the file is damaged", "run the stage again")
        return beside(self)

    beside = Source.beside
    monkeypatch.setattr(Source, "beside", damaged)
    assert sorted(landmarks_of(workspace, step, correspondence, console.warn)) == ["b"]
    assert console.warnings == ["a: shown without landmarks: the file is damaged; try: run the stage again"]


def hang(workspace: Workspace, shape: str) -> list[str]:
    time.sleep(600)
    return []


def crash(workspace: Workspace, shape: str) -> list[str]:
    os.abort()


@pytest.mark.parametrize(("what", "fact"), [(hang, "did not finish within 1 s"), (crash, "the process crashed")])
def test_what_hangs_or_crashes_beside_the_stages_leaves_their_notes_alone(
    project: Callable[..., Project], tmp_path: Path, what: Callable[[Workspace, str], list[str]], fact: str
) -> None:
    workspace = make_workspace(project(stages=CHAIN))
    note = tmp_path / "out/shapes/a/failed.txt"
    note.parent.mkdir(parents=True)
    note.write_text("of a stage")
    found: list[Outcome] = []
    job = Job(
        workspace.only(["a"]), (), "a", ("a",), closing=Closing("report", what), aside=True,
        timeout_s=1.0 if what is hang else None,
    )  # fmt: skip
    with Batch(1, tmp_path / "scratch", timeout_s=300.0) as batch:
        batch.run([job], lambda _, outcome: found.append(outcome))
    assert found[0].failure is not None
    assert fact in found[0].failure.error
    assert note.read_text() == "of a stage"
