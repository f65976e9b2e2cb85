"""What ``check`` finds before a run: the same scans are refused, for the same reasons."""

from __future__ import annotations

import errno
import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.check import ScanCheck, check_output, check_project, inspect, print_checks
from ssmpipe.runner.console import Console
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.run_options import RunOptions
from tests.support.toys import tetrahedron

Load = Callable[..., Project]
Run = Callable[..., RunResult]


def two_tetrahedra() -> TriMesh:
    one = tetrahedron()
    return TriMesh(np.vstack([one.vertices, one.vertices + 50]), np.vstack([one.faces, one.faces + 4]))


def errors(project: Project) -> dict[str, str]:
    steps = (project.plan.steps, project.registry, project.config.seed)
    return {i: inspect(source, *steps).error for i, source in project.sources.items()}


def test_what_a_run_refuses_is_refused(project: Load, run: Run, scans: Path) -> None:
    write_mesh(scans / "b.ply", two_tetrahedra())
    chain = ["repair", "grow", "shift", "total"]
    found = {check.id: check for check in check_project(project("stages.grow.refuse=[c]", stages=chain))}
    result = run("stages.grow.refuse=[c]", "stages.repair.components=one", stages=chain, options=RunOptions(jobs=2))
    assert {i for i, check in found.items() if check.error} == set(result.failures) == {"b", "c"}
    for i, failure in result.failures.items():
        assert found[i].error == f"{failure.stage}: {failure.error}; try: {failure.remedy}"
    assert (found["b"].n_components, found["b"].n_faces) == (2, 8)


def test_options_of_the_config_count(project: Load, scans: Path) -> None:
    write_mesh(scans / "b.ply", two_tetrahedra())
    kept = errors(project("stages.repair.components=largest", stages=["repair", "shift"]))
    assert kept == dict.fromkeys("abcd", "")


def test_a_size_that_no_scan_has_is_a_warning_where_the_anatomy_tells_none(project: Load) -> None:
    one = project()
    for units, told in (("mm", False), ("m", True), ("um", True), ("none", False)):
        source = replace(next(iter(one.sources.values())), units=units)
        found = inspect(source, one.plan.steps, one.registry, one.config.seed)
        assert not found.error
        assert any(f"with input.units: {units}" in w for w in found.warnings) is told, units


def test_nothing_is_written_and_no_bug_ends_it(project: Load, tmp_path: Path) -> None:
    found = errors(project("stages.grow.bug=[a]"))
    assert found["a"] == "internal error ZeroDivisionError: oops"
    assert found["b"] == ""
    assert not (tmp_path / "out").exists()


def test_an_output_folder_that_cannot_be_written_is_told(
    project: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = project()
    before = sorted(tmp_path.rglob("*"))
    assert check_output(loaded) == ""
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "in the way").write_text("")
    inside = replace(loaded, out=tmp_path / "in the way" / "out")
    assert "in the way: Not a directory); try: free space, check permissions, or change `output`" in check_output(
        inside
    )
    (loaded.out / "cohort").mkdir(parents=True)
    make = tempfile.TemporaryFile

    def read_only(dir: Path) -> Any:
        if dir == loaded.out / "cohort":
            raise OSError(errno.EROFS, "Read-only file system")
        return make(dir=dir)

    monkeypatch.setattr(tempfile, "TemporaryFile", read_only)
    assert check_output(loaded).startswith(f"output: nothing can be written to {loaded.out / 'cohort'}")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_permissions_of_the_output_folder_count(project: Load) -> None:
    loaded = project()
    loaded.out.mkdir(mode=0o500)
    assert "Permission denied" in check_output(loaded)


def test_a_role_without_its_landmark(tmp_path: Path, project: Load) -> None:
    marks = {i: {"head": [0, 0, 0], "tip": [0, 0, 0]} for i in "ab"} | {"c": {"tip": [6, 6, 6]}}
    (tmp_path / "marks.json").write_text(json.dumps(marks))
    given = {"landmarks": "marks.json", "roles": {"corner_2": "head"}}
    found = errors(
        project(input=given, anatomy="disk", stages=[{"repair": {"skip": True}}, {"smooth": {"skip": True}}])
    )
    assert "head" not in found["a"]
    assert "parameterize: landmark 'head' (role 'corner_2') is missing" in found["c"]
    assert "parameterize: landmark 'head' (role 'corner_2') is missing" in found["d"]  # no landmarks at all


def test_the_cost_of_the_group_stages_is_said_where_there_is_an_optimize(
    project: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    one = project(anatomy="disk", stages=[{"optimize": {"landmarks": [21, 31], "n_coefficients": [5, 6]}}])
    fine = [ScanCheck(i, f"{i}.ply") for i in "abcd"]
    print_checks(fine, one, Console())
    text = " ".join(capsys.readouterr().out.split())
    assert "group stages, 4 shapes x 651 landmarks x 30 coefficients: about" in text
    assert "of memory" in text
    assert "size [mm]" in text, "brackets are text, not markup"
    print_checks([replace(c, error="bad") for c in fine[:2]] + fine[2:], one, Console())
    assert "group stages" not in capsys.readouterr().out, "too few shapes are left"


def test_a_preset_that_does_not_check_sides_says_so(
    project: Load, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*overrides: str, **changes: Any) -> str:
        one = project(*overrides, stages=[], **changes)
        print_checks([ScanCheck(i, f"{i}.ply", source.side) for i, source in one.sources.items()], one, Console(0))
        printed = capsys.readouterr()
        return " ".join((printed.out + printed.err).split())

    (tmp_path / "cohort.csv").write_text("id,side\na,L\nb,L\nc,R\nd,R\n")
    assert "left and right are not checked" in said(anatomy="disk")
    assert "left and right are mixed (2 L, 2 R)" in said(anatomy="disk", input={"cohort": "cohort.csv"})
    silent = said("stages.align.check_mirror=true", anatomy="disk"), said(anatomy="aorta"), said(anatomy="femur-distal")
    assert not any("left and right are" in text for text in silent)
