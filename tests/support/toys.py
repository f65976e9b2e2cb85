"""Toy scans, configs and stages for the tests of the runner and the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.config_problems import ConfigErrors
from ssmpipe.runner.console import Console
from ssmpipe.runner.dry_run import dry_run
from ssmpipe.runner.project import Project, load_project
from ssmpipe.runner.registry import BUILTIN, Registry
from ssmpipe.runner.run import RunResult, run_project
from ssmpipe.runner.run_options import RunOptions

TOY = Path(__file__).parent / "toy_stages"
IDS = ("a", "b", "c", "d")
GOOD = """\
name: toys
input:
  scans: scans
output: out
stages:
  - grow: {factor: 3}
  - total
"""


def tetrahedron(size: float = 10.0, at: float = 0.0) -> TriMesh:
    vertices = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + at
    return TriMesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


@pytest.fixture
def registry() -> Registry:
    return Registry((BUILTIN, TOY))


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    folder = tmp_path / "scans"
    folder.mkdir()
    for i, name in enumerate(IDS):
        write_mesh(folder / f"{name}.ply", tetrahedron(10.0 + i, 3.0 * i))
    return folder


@pytest.fixture
def write_config(tmp_path: Path, scans: Path) -> Callable[..., Path]:
    def write(**changes: Any) -> Path:
        config: dict[str, Any] = {
            "name": "toys",
            "input": {"scans": "scans/*.ply", **changes.pop("input", {})},
            "output": "out",
            "stages": [{"grow": {}}, {"shift": {}}, {"total": {}}],
            **changes,
        }
        path = tmp_path / "toys.yaml"
        with path.open("w") as file:
            YAML(typ="safe").dump(config, file)
        return path

    return write


@pytest.fixture
def project(write_config: Callable[..., Path], registry: Registry) -> Callable[..., Project]:
    def load(*overrides: str, **changes: Any) -> Project:
        return load_project(write_config(**changes), overrides, registry)

    return load


@pytest.fixture
def run(project: Callable[..., Project]) -> Callable[..., RunResult]:
    def go(*overrides: str, options: RunOptions | None = None, **changes: Any) -> RunResult:
        return run_project(project(*overrides, **changes), options or RunOptions(jobs=2), Console(-1))

    return go


@pytest.fixture
def problems(tmp_path: Path, scans: Path, registry: Registry) -> Callable[..., list[str]]:
    def find(text: str, *overrides: str) -> list[str]:
        path = tmp_path / "c.yaml"
        path.write_text(text)
        try:
            load_project(path, overrides, registry)
        except ConfigErrors as error:
            return [p.replace(str(tmp_path) + "/", "") for p in error.problems]
        return []

    return find


def reasons(project: Project) -> dict[tuple[str, str], str]:
    return {(f.step, f.shape): f.reason for f in dry_run(project, RunOptions())}
