"""The README's main job: the committed synthetic cohort from raw scans to a report, checked against its truth."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.evaluation.correspondence_error import correspondence_error
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.io.meshes import read_mesh

ROOT = Path(__file__).resolve().parents[2]
COHORT = ROOT / "data_synthetic" / "femur_distal"


def ssmpipe(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "ssmpipe", *arguments], capture_output=True, text=True, cwd=ROOT, timeout=600
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("quickstart") / "out"
    done = ssmpipe("run", "configs/quickstart.yaml", "--set", f"output={folder}")
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "cohort" / "optimize" / "correspondence.npz") as z:
        return dict(z)


def test_correspondence_has_the_promised_arrays(result):
    n_s, n_p = 6, 51 * 51
    expected = {
        "points": (n_s, n_p, 3),
        "points_scan": (n_s, n_p, 3),
        "initial_points": (n_s, n_p, 3),
        "initial_points_scan": (n_s, n_p, 3),
        "transform": (n_s, 4, 4),
        "scale": (n_s,),
        "parameters": (n_s, n_p, 2),
        "grid": (2,),
        "faces": (2 * 50 * 50, 3),
        "description_length": (2,),
        "eigenvalues": (n_s - 1,),
        "eigenvalues_initial": (n_s - 1,),
    }
    for name, shape in expected.items():
        assert result[name].shape == shape, name
        assert result[name].dtype == (np.int64 if name in ("grid", "faces") else np.float64), name
    assert list(result["ids"]) == [f"femur_{k:02d}" for k in range(1, 7)]
    assert str(result["topology"]) == "disk"
    assert result["description_length"][1] < result["description_length"][0]


def test_scan_points_are_the_aligned_ones_moved_back(result):
    for points, scan, matrix in zip(result["points"], result["points_scan"], result["transform"], strict=True):
        np.testing.assert_allclose(scan @ matrix[:3, :3].T + matrix[:3, 3], points, atol=1e-9)
        assert abs(abs(np.linalg.det(matrix[:3, :3])) - 1) < 1e-12


def test_points_of_every_scan_lie_on_it_also_when_it_was_mirrored(result):
    sides = {row["id"]: row["side"] for row in csv.DictReader((COHORT / "cohort.csv").read_text().splitlines())}
    for i, scan, matrix in zip(result["ids"], result["points_scan"], result["transform"], strict=True):
        assert (np.linalg.det(matrix[:3, :3]) < 0) == (sides[str(i)] == "L"), i
        distance = point_to_mesh(scan, read_mesh(COHORT / "scans" / f"{i}.ply"))[0]
        assert distance.max() < 1.0, i
    assert set(sides.values()) == {"L", "R"}


def test_the_error_against_the_truth_is_halved(result):
    with np.load(COHORT / "truth.npz") as known:
        order = [list(known["ids"]).index(i) for i in result["ids"]]
        truth = known["points"][order]
    moved = truth @ np.swapaxes(result["transform"][:, :3, :3], 1, 2) + result["transform"][:, None, :3, 3]
    off = ~np.eye(6, dtype=bool)
    before, after = (
        correspondence_error(result[k], result["faces"], moved)[off].mean() for k in ("initial_points", "points")
    )
    assert before > 3.0
    assert after < 0.5 * before


def test_every_shape_is_proved(out):
    certificate = json.loads((out / "cohort" / "optimize" / "certificate.json").read_text())
    assert len(certificate["shapes"]) == 6
    assert all(s["status"] == "proved" and s["lower_bound"] > 0 for s in certificate["shapes"].values())


def test_the_promised_files_are_there(out):
    for name in (
        "run.json",
        "report.html",
        "cohort/optimize/history.csv",
        "cohort/model/model.npz",
        "cohort/model/model.h5",
        "cohort/model/mean.ply",
        "cohort/model/mode_01_minus3.ply",
        "cohort/model/scores.csv",
        "cohort/evaluate/measures.csv",
        "cohort/evaluate/landmark_transfer.csv",
        "cohort/optimize/femur_03.ply",
    ):
        assert (out / name).stat().st_size > 0, name
    assert not (out / "failures.json").exists()


def test_tables_start_with_the_shape_and_measures_improve(out):
    rows = list(
        csv.reader(
            line for line in (out / "cohort/model/scores.csv").read_text().splitlines() if not line.startswith("#")
        )
    )
    assert rows[0][0] == "id"
    assert len(rows) == 7
    lines = [
        line for line in (out / "cohort/evaluate/measures.csv").read_text().splitlines() if not line.startswith("#")
    ]
    table = list(csv.DictReader(lines))
    first = {r["correspondence"]: float(r["generalization"]) for r in table if r["n_modes"] == "1"}
    assert first["optimized"] < first["initial"]


def test_a_second_run_does_nothing(out):
    stamp = (out / "cohort/optimize/correspondence.npz").stat().st_mtime_ns
    done = ssmpipe("run", "configs/quickstart.yaml", "--set", f"output={out}")
    assert done.returncode == 0
    assert "up to date" in done.stdout + done.stderr
    assert (out / "cohort/optimize/correspondence.npz").stat().st_mtime_ns == stamp
