from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.dry_run import dry_run
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult
from ssmpipe.runner.run_options import RunOptions
from tests.support.toys import reasons, tetrahedron

Load = Callable[..., Project]
Run = Callable[..., RunResult]


def test_every_reason_in_a_dry_run(run: Run, project: Load, tmp_path: Path, scans: Path) -> None:
    everything = reasons(project())
    assert set(everything.values()) == {"first run"}
    assert not (tmp_path / "out").exists()
    run()
    assert set(reasons(project()).values()) == {"up to date"}
    out = tmp_path / "out"
    (out / "shapes/a/01-grow/mesh.ply").unlink()
    write_mesh(out / "shapes/b/01-grow/mesh.ply", tetrahedron(99))
    write_mesh(scans / "c.ply", tetrahedron(50))
    found = reasons(project())
    assert found["grow", "a"] == "output missing: mesh.ply"
    assert found["grow", "b"] == "output modified: mesh.ply"
    assert found["grow", "c"] == "input changed: mesh"
    assert found["grow", "d"] == "up to date"
    assert found["shift", "d"].startswith("input may change: reference")
    assert reasons(project("seed=1"))["grow", "d"] == "seed changed: 0 -> 1"
    forced = dry_run(project(), RunOptions(forced=frozenset({"grow"}), shapes=("d",)))
    assert forced[0].reason == "forced"
