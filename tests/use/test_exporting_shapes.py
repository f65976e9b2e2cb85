"""What other programs get of a whole cohort: every file is read back, by its own rules, and compared."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.contract import Table
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.io.arrays import write_npz
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.outlines import read_outline
from ssmpipe.io.shapeworks import read_particles
from ssmpipe.io.tables import write_table
from ssmpipe.use.model import load_model
from ssmpipe.use.results import shell_distances
from tests.support.models import curve_model, shape_model, write_model

HOSTILE = '</script>, "quoted"; é'


def finished(model: ShapeModel, out: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """A result folder whose first scan was mirrored; return it, the points of the scans and the transforms."""
    write_model(model, out)
    n, d = len(model.ids), model.mean.shape[1]
    points = model.mean + np.tensordot(model.scores * np.sqrt(model.variances), model.modes, axes=1)
    transforms = np.tile(np.eye(4), (n, 1, 1))
    transforms[:, :3, 3] = np.arange(3 * n).reshape(n, 3)
    transforms[0, 0, 0] = -1.0
    back = np.linalg.inv(transforms)
    scan = np.einsum("sij,spj->spi", back[:, :d, :d], points) + back[:, None, :d, 3]
    (out / "cohort/optimize").mkdir()
    arrays = {"ids": np.array(model.ids), "points": points, "points_scan": scan, "transform": transforms}
    write_npz(out / "cohort/optimize/correspondence.npz", arrays)
    table = {
        "id": list(model.ids),
        "mode_01": model.scores[:, 0].tolist(),
        "group": ["a", "b"] * (n // 2) + ["b"] * (n % 2),
    }
    write_table(out / "cohort/model/scores.csv", Table({**table, "note": [HOSTILE] * n}))
    return out, scan, transforms


def export(result: Path, target: Path, *arguments: str, code: int = 0) -> str:
    done = CliRunner().invoke(main, ["export", str(result), "-o", str(target), *arguments])
    assert done.exit_code == code, done.output
    return done.output


@pytest.mark.parametrize("topology", ["tube", "closed"])
def test_shapeworks_project(topology: str, tmp_path: Path) -> None:
    model = shape_model(topology)
    result, scan, transforms = finished(model, tmp_path / "out")
    export(result, tmp_path / "to/bones.swproj")
    project = json.loads((tmp_path / "to/bones.swproj").read_text(encoding="utf-8"))
    names = ["data", "groom", "optimize", "studio", "project", "analysis", "deepssm", "landmarks"]
    assert list(project) == names
    assert project["project"] == {"version": "2"}
    assert [row["name"] for row in project["data"]] == list(model.ids)
    n_distinct = len(np.unique(model.mean, axis=0))
    for k, row in enumerate(project["data"]):
        assert all(isinstance(value, str) for value in row.values())
        assert (row["group_group"], row["note"]) == ("ab"[k % 2], HOSTILE)
        local, world = (read_particles(tmp_path / "to" / row[f"{kind}_particles_1"]) for kind in ("local", "world"))
        assert local.shape == world.shape == (n_distinct, 3)
        alignment, procrustes = (
            np.array(row[f"{kind}_1"].split(), dtype=float).reshape(4, 4) for kind in ("alignment", "procrustes")
        )
        np.testing.assert_array_equal(alignment, transforms[k])
        both = procrustes @ alignment
        np.testing.assert_allclose(local @ both[:3, :3].T + both[:3, 3], world, atol=1e-10)
        mesh = read_mesh(tmp_path / "to" / row["groomed_1"])
        np.testing.assert_array_equal(mesh.vertices, local)
        assert volume(mesh) > 0, "outward, also where the scan was mirrored"
        assert {tuple(p) for p in local} <= {tuple(p) for p in scan[k]}
    assert (tmp_path / "to/bones_particles/s0_local.particles").read_text().count("\n") == n_distinct
    first = (tmp_path / "to/bones.swproj").read_bytes()
    export(result, tmp_path / "to/bones.swproj")
    assert (tmp_path / "to/bones.swproj").read_bytes() == first


@pytest.mark.parametrize("form", ["ply", "stl", "vtp"])
@pytest.mark.parametrize("frame", ["scan", "model"])
def test_surfaces_of_the_shapes(form: str, frame: str, tmp_path: Path) -> None:
    model = shape_model("cone")
    result, scan, _ = finished(model, tmp_path / "out")
    assert "6 files" in export(result, tmp_path / "to", "--shapes", form, "--frame", frame)
    points = model.mean + np.tensordot(model.scores * np.sqrt(model.variances), model.modes, axes=1)
    for k, shape_id in enumerate(model.ids):
        mesh = read_mesh(tmp_path / f"to/{shape_id}.{form}")
        wanted = np.unique((scan if frame == "scan" else points)[k].round(6), axis=0)
        assert mesh.n_vertices == len(np.unique(model.mean, axis=0)), "the copies of the pole are one"
        found = np.unique(mesh.vertices.round(6), axis=0)
        assert abs(found - wanted).max() < 2e-5
        assert volume(mesh) > 0
    export(result, tmp_path / "one", "--shapes", form, "--shape", "s3")
    assert [p.name for p in (tmp_path / "one").iterdir()] == [f"s3.{form}"]


def test_arrays_of_vtp_files(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="VTK itself reads the file: pip install 'ssmpipe[vtk]'")
    model = shape_model("tube")
    result, _, _ = finished(model, tmp_path / "out")
    export(result, tmp_path / "to", "--shapes", "vtp", "--frame", "model")
    export(result, tmp_path / "mean.vtp")
    mean = pyvista.read(tmp_path / "mean.vtp")
    np.testing.assert_array_equal(np.asarray(mean.field_data["scores"]), model.scores)
    np.testing.assert_array_equal(np.asarray(mean.field_data["variances"]), model.variances)
    for k, shape_id in enumerate(model.ids):
        shape = pyvista.read(tmp_path / f"to/{shape_id}.vtp")
        np.testing.assert_array_equal(np.asarray(shape.field_data["scores"]), model.scores[k])
        np.testing.assert_allclose(shape.points - shape["displacement"], mean.points, atol=1e-10)
        np.testing.assert_allclose(shape["distance"], mean[f"distance_{shape_id}"], atol=1e-10)


def test_arrays_of_vtp_files_as_text(tmp_path: Path) -> None:
    """Without VTK: the names and sizes that the file declares."""
    model = shape_model("tube")
    result, _, _ = finished(model, tmp_path / "out")
    export(result, tmp_path / "mean.vtp")
    text = (tmp_path / "mean.vtp").read_text()
    assert all(f'Name="distance_{i}"' in text for i in model.ids)
    assert f'Name="scores" NumberOfComponents="{len(model.variances)}" NumberOfTuples="6"' in text


def test_a_bump_outward_is_a_positive_distance(tmp_path: Path) -> None:
    model = load_model(write_model(shape_model("tube"), tmp_path / "out"))
    middle = np.array([0, 0, 15.0])
    grown = model.mean + 0.01 * (model.mean - middle)
    found = shell_distances(model, grown[None])[0]
    assert found.shape == (len(model.mean),)
    assert (found > 0).all()
    np.testing.assert_allclose(found.reshape(model.shape_model.grid)[:, 4], 0.1, rtol=0.2)


def test_csv_for_r(tmp_path: Path) -> None:
    model = shape_model("disk")
    result, _, _ = finished(model, tmp_path / "out")
    export(result, tmp_path / "bones.csv")
    with (tmp_path / "bones.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:4] == ["id", "group", "note", "centroid_size"]
    assert [row["id"] for row in rows] == list(model.ids)
    assert {row["note"] for row in rows} == {HOSTILE}
    points = model.mean + np.tensordot(model.scores * np.sqrt(model.variances), model.modes, axes=1)
    numbers = np.array([[float(v) for k, v in row.items() if k.startswith("p")] for row in rows])
    np.testing.assert_allclose(numbers.reshape(points.shape), points, atol=1e-12)
    scores = np.array([[float(v) for k, v in row.items() if k.startswith("mode_")] for row in rows])
    np.testing.assert_array_equal(scores, model.scores)


def test_gias_layout(tmp_path: Path) -> None:
    model = shape_model("tube")
    export(write_model(model, tmp_path / "out"), tmp_path / "m.pc.npz")
    with np.load(tmp_path / "m.pc.npz", allow_pickle=False) as file:
        assert set(file.files) == {"mean", "weights", "modes", "SD", "sizes", "projectedWeights"}
        assert file["SD"].shape == ()
        rebuilt = file["mean"][:, None] + file["modes"] @ file["projectedWeights"]
        np.testing.assert_allclose(file["modes"].T @ file["modes"], np.eye(len(model.variances)), atol=1e-10)
        np.testing.assert_array_equal(file["weights"], model.variances)
        np.testing.assert_allclose(file["projectedWeights"].var(axis=1, ddof=1), model.variances, rtol=1e-8)
    points = model.mean + np.tensordot(model.scores * np.sqrt(model.variances), model.modes, axes=1)
    np.testing.assert_allclose(rebuilt.T.reshape(points.shape), points, atol=1e-10)


def test_outlines_of_curves(tmp_path: Path) -> None:
    model = curve_model()
    result, scan, _ = finished(model, tmp_path / "out")
    export(result, tmp_path / "to", "--shapes", "ply")
    outline = read_outline(tmp_path / "to/s2.csv")
    assert outline.closed
    np.testing.assert_array_equal(outline.points, scan[2])
    assert "one of curves" in export(result, tmp_path / "m.swproj", code=2)


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    lonely = write_model(shape_model(), tmp_path / "lonely")
    assert "no optimize/correspondence.npz" in export(lonely, tmp_path / "m.swproj", code=3)
    assert "no optimize/correspondence.npz" in export(lonely, tmp_path / "to", "--shapes", "ply", code=3)
    result, _, _ = finished(shape_model(), tmp_path / "out")
    assert "no shape 'x'" in export(result, tmp_path / "to", "--shapes", "ply", "--shape", "x", code=2)
    assert "not one instance" in export(result, tmp_path / "m.csv", "--at", "1=2", code=2)
    assert "--shape needs --shapes" in export(result, tmp_path / "m.ply", "--shape", "s1", code=2)
    assert "exclude each other" in export(result, tmp_path / "m", "--shapes", "ply", "--at", "1=2", code=2)
    assert "'.npz' is not a format" in export(result, tmp_path / "m.npz", code=2)
