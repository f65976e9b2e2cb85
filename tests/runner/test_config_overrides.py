from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.project import load_project
from ssmpipe.runner.registry import Registry
from tests.support.toys import GOOD, tetrahedron


def test_overrides(tmp_path: Path, scans: Path, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD)
    other = tmp_path / "elsewhere"
    (other / "more").mkdir(parents=True)
    for name in "xyz":
        write_mesh(other / "more" / f"{name}.stl", tetrahedron())
    monkeypatch.chdir(other)
    project = load_project(
        path,
        ["input.scans=more", "seed=7", "stages.grow.factor=1e1", "stages.total.weight=2", "limits.timeout_s=null"],
        registry,
    )
    assert sorted(project.sources) == ["x", "y", "z"]
    assert project.config.seed == 7
    assert project.config.limits.timeout_s is None
    assert [s.options.get("factor", s.options.get("weight")) for s in project.steps] == [10.0, 2.0]
    assert project.out == tmp_path / "out"
    assert load_project(path, ["output=here"], registry).out == other / "here"


def test_override_problems_name_the_option(problems: Callable[..., list[str]]) -> None:
    assert problems(GOOD, "sed=3") == ["--set sed=3: sed: unknown key; did you mean 'seed'?"]
    (found,) = problems(GOOD, "stages.grow.factr=3")
    assert found == "--set stages.grow.factr=3: stages.0.grow.factr: unknown key; did you mean 'factor'?"
    (found,) = problems(GOOD, "stages.grov.factor=3")
    assert found.startswith("--set stages.grov.factor=3: stages.2: unknown stage 'grov'; did you mean 'grow'?")
