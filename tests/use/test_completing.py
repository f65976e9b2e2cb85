"""Fragments from the command line: completed, filled, or refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.model.shape_model import Chain
from ssmpipe.io.arrays import read_npz
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.io.models import write_model
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
