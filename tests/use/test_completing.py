"""Fragments from the command line: completed, filled, or refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.model.shape_model import Chain
from ssmpipe.io.arrays import read_npz
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.io.models import write_model
from ssmpipe.use.completing import Fragment, _best_image, _filled
from ssmpipe.use.projected_results import ProjectResult, exit_code_of
from tests.core.model.test_completion import fragment, setting
from tests.support.eggs import ssmpipe

CHAIN = {
    "ssmpipe": "0", "seed": 0, "kind": "mesh", "units": "mm", "roles": {}, "anatomy": "closed", "diagonal_mm": None, "tolerance_mm": 20.0,
    "steps": [
        {"id": "orient", "stage": "orient", "version": 1, "options": {"mirror": "none"}, "from": {}},
        {"id": "optimize", "stage": "optimize", "version": 7, "options": {"n_coefficients": [8, 8], "landmarks": [31, 21]}, "from": {}},
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def completed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fragment")
    model, _, whole = setting()
    write_model(folder / "model.npz", replace(model, lambda_cut=0.01, chain=Chain(json.dumps(CHAIN))))
    part, _ = fragment(whole, 0, 0.75)
    write_mesh(folder / "whole.ply", whole)
    write_mesh(folder / "part.ply", part)
    (folder / "broken.ply").write_text("ply\n")
    code, text = ssmpipe(
        "project",
        folder / "model.npz",
        folder / "part.ply",
        folder / "broken.ply",
        "-o",
        folder / "out",
        "--fill",
        "-j",
        "1",
    )
    assert code == 3, text
    assert "% seen" in text
    return folder


def test_the_table_says_what_was_seen(completed: Path) -> None:
    lines = [x for x in (completed / "out/scores.csv").read_text().splitlines() if not x.startswith("#")]
    (row,) = csv.DictReader(lines)
    assert row["id"] == "part"
    assert 0.4 < float(row["seen_share"]) < 0.9
    assert row["certificate"] == "partial"
    assert float(row["from_scan_mean_mm"]) < 0.3
    assert list(json.loads((completed / "out/failures.json").read_text())) == ["broken"]


def test_the_completed_surface_is_near_the_whole_in_the_coordinates_of_the_scan(completed: Path) -> None:
    whole = read_mesh(completed / "whole.ply")
    surface = read_mesh(completed / "out/patients/part/completed.ply")
    assert point_to_mesh(surface.vertices, whole)[0].mean() < 0.4
    found = read_npz(completed / "out/patients/part/projection.npz")
    moved = found["points_scan"] @ found["transform"][:3, :3].T + found["transform"][:3, 3]
    np.testing.assert_allclose(moved, found["points"], atol=1e-9)
    assert found["deviation"][~found["seen"]].mean() > found["deviation"][found["seen"]].mean()


def test_the_scan_stays_and_its_hole_is_filled(completed: Path) -> None:
    part, filled = read_mesh(completed / "part.ply"), read_mesh(completed / "out/patients/part/filled.ply")
    whole = read_mesh(completed / "whole.ply")
    assert boundary_loops(filled.faces) == []
    assert point_to_mesh(part.vertices, filled)[0].max() < 1e-9
    assert point_to_mesh(whole.vertices, filled)[0].mean() < 0.5
    assert 0 < json.loads((completed / "out/patients/part/projection.json").read_text())["filled_share"] < 0.5


def test_the_vtp_carries_the_uncertainty(completed: Path) -> None:
    text = (completed / "out/patients/part/completed.vtp").read_text()
    assert all(f'Name="{name}"' in text for name in ("sd_mm", "sd_along_normal_mm", "seen"))


def test_holes_that_cannot_be_filled_are_counted_and_end_with_3(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, whole = setting()
    part, _ = fragment(whole, 0, 0.75)
    given, share, n_left = _filled(part, whole, model, [])
    assert (share > 0.1, n_left) == (True, 0)

    def refuse(*_: object) -> None:
        raise GeometryError("the patch folds over", "")

    monkeypatch.setattr("ssmpipe.use.completing.fill_towards", refuse)
    warnings: list[str] = []
    given, share, n_left = _filled(part, whole, model, warnings)
    assert (given.n_faces, share, n_left) == (part.n_faces, 0.0, 1)
    assert "the holes were not filled: the patch folds over" in warnings[0]
    row = {"certificate": {"status": "partial"}, "holes_left": n_left}
    assert exit_code_of(ProjectResult(0, {"part": row})) == 3
    assert exit_code_of(ProjectResult(0, {"part": {**row, "holes_left": 0}})) == 0


@pytest.mark.parametrize(
    ("step", "side", "says"),
    [
        ({"stage": "orient", "options": {"mirror": "left"}}, None, "the side is unknown; it was taken as it is"),
        ({"stage": "align", "options": {"chirality": "best-fit"}}, "R", "the model does not go by sides"),
    ],
)
def test_side_is_asked_for_only_where_it_would_help(
    step: dict[str, Any], side: str | None, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, _, whole = setting()
    found = SimpleNamespace(points=model.mean, matrix=np.eye(4), rms=0.0)
    monkeypatch.setattr("ssmpipe.use.completing.complete", lambda *_: found)
    warnings: list[str] = []
    _best_image(whole, Fragment(whole, np.eye(4), side, [step], False), model, cast(Any, None), warnings)
    assert len(warnings) == 1
    assert warnings[0].startswith(says)
    assert ("say --side" in warnings[0]) is (side is None)


def test_a_second_call_that_fails_leaves_nothing_of_the_first(completed: Path) -> None:
    out = completed / "out"
    assert (out / "patients/part/completed.ply").exists()
    assert "completed by the model model.npz" in (out / "part.html").read_text()
    again = completed / "again"
    again.mkdir()
    (again / "part.ply").write_text("ply\n")
    code, text = ssmpipe("project", completed / "model.npz", again / "part.ply", "-o", out, "--partial", "-j", "1")
    assert code == 3, text
    assert "--partial" not in text, "the file cannot be read: no word of fragments"
    assert not (out / "patients/part").exists()
    assert not (out / "part.html").exists()


def test_a_fragment_that_the_stages_refuse_is_told_of_partial(completed: Path, tmp_path: Path) -> None:
    names = ("repair", "parameterize", "sample", "fit")
    steps = [{"id": n, "stage": n, "version": 1, "options": {}, "from": {}} for n in names]
    steps[1]["options"] = {"topology": "closed"}
    content = {**CHAIN, "diagonal_mm": [1e4, 1e5], "anatomy": "femur-distal", "steps": [*steps, CHAIN["steps"][-1]]}
    model, _, _ = setting()
    write_model(tmp_path / "model.npz", replace(model, lambda_cut=0.01, chain=Chain(json.dumps(content))))
    code, text = ssmpipe("project", tmp_path / "model.npz", completed / "part.ply", "-o", tmp_path / "out", "-j", "1")
    assert code == 3, text
    assert "if it shows a part only: --partial" in text
    failure = json.loads((tmp_path / "out/failures.json").read_text())["part"]
    assert failure["remedy"].endswith("--partial")
    code, text = ssmpipe(
        "project", tmp_path / "model.npz", completed / "part.ply", "-o", tmp_path / "out", "-j", "1", "--partial"
    )
    assert code == 0, text
