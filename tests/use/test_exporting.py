from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.core.spline.fit import interpolating_surface, surface_grid
from ssmpipe.io.meshes import read_mesh
from tests.support.models import grid_points, shape_model, write_model


def export(result: Path, target: Path, *arguments: str) -> str:
    done = CliRunner().invoke(main, ["export", str(result), "-o", str(target), *arguments])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".off", ".vtp"])
def test_the_mean_as_a_mesh(suffix: str, tmp_path: Path) -> None:
    model = shape_model("tube")
    result = write_model(model, tmp_path / "out")
    assert "mean" in export(result, tmp_path / f"mean{suffix}")
    mesh = read_mesh(tmp_path / f"mean{suffix}")
    assert mesh.n_faces == len(model.faces)
    assert np.allclose(np.ptp(mesh.vertices, axis=0), np.ptp(model.mean, axis=0), atol=1e-4)
    moved = np.zeros(1)
    moved[0] = -2.0
    assert "instance" in export(result, tmp_path / f"there{suffix}", "--at", "1=-2")
    there = read_mesh(tmp_path / f"there{suffix}")
    assert np.allclose(np.ptp(there.vertices, axis=0), np.ptp(model.instance(moved), axis=0), atol=1e-4)


def test_statismo_layout(tmp_path: Path) -> None:
    model = shape_model()
    export(write_model(model, tmp_path / "out"), tmp_path / "m.h5")
    with h5py.File(tmp_path / "m.h5") as file:
        assert np.allclose(file["model/mean"][:].reshape(-1, 3), model.mean, atol=1e-5)
        assert np.allclose(file["model/pcaVariance"][:], model.variances, rtol=1e-6)


def test_unknown_formats_are_refused(tmp_path: Path) -> None:
    result = write_model(shape_model(), tmp_path / "out")
    done = CliRunner().invoke(main, ["export", str(result), "-o", str(tmp_path / "m.xyz")])
    assert done.exit_code == 2
    assert "'.xyz' is not a format that a model can be exported to; try: use one of .h5" in done.output


@pytest.mark.parametrize("command", ["export", "sample"])
def test_a_missing_model_is_bad_usage(command: str, tmp_path: Path) -> None:
    for place, fact in ((tmp_path / "none", "there is no"), (tmp_path, "holds no model.npz")):
        done = CliRunner().invoke(main, [command, str(place), "-o", str(tmp_path / "m.ply")])
        assert (done.exit_code, fact in done.output) == (2, True), done.output
    (tmp_path / "model.npz").write_bytes(b"no archive")  # a file that is refused
    done = CliRunner().invoke(main, [command, str(tmp_path), "-o", str(tmp_path / "m.ply")])
    assert done.exit_code == 3, done.output


@pytest.mark.parametrize("topology", ["disk", "tube", "cone", "closed"])
def test_the_interpolating_surface_passes_through_the_grid(topology: str) -> None:
    grid = grid_points(topology, 12, 9).reshape(12, 9, 3)
    closed = topology != "disk"
    surface = interpolating_surface(grid, closed_u=closed)
    at = surface_grid(surface, 13 if closed else 12, 9)
    assert np.allclose(at[:12], grid, rtol=0, atol=1e-9)
    if closed:
        assert np.array_equal(surface.control_points[0], surface.control_points[-1])


@pytest.mark.parametrize(("suffix", "tolerance"), [(".step", 1e-6), (".iges", 1e-3)])
def test_cad_files_read_back(suffix: str, tolerance: float, tmp_path: Path) -> None:
    pytest.importorskip("OCP", reason="OpenCASCADE is not installed: pip install 'ssmpipe[cad]'")
    from ssmpipe.io.cad import cad_points

    model = shape_model("tube", 20, 12)
    result = write_model(model, tmp_path / "out")
    export(result, tmp_path / f"a{suffix}")
    export(result, tmp_path / f"b{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes().replace(b"a.iges", b"b.iges") == (
        tmp_path / f"b{suffix}"
    ).read_bytes()
    found = cad_points(tmp_path / f"a{suffix}", 50, 50)
    wanted = interpolating_surface(model.mean.reshape(20, 12, 3), closed_u=True)
    assert np.abs(found - surface_grid(wanted, 50, 50)).max() < tolerance


def test_without_opencascade_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name in ["OCP", "OCP.BRep", *(loaded for loaded in sys.modules if loaded.startswith("OCP."))]:
        monkeypatch.setitem(sys.modules, name, None)
    result = write_model(shape_model(), tmp_path / "out")
    done = CliRunner().invoke(main, ["export", str(result), "-o", str(tmp_path / "m.step")])
    assert done.exit_code == 3
    assert "pip install 'ssmpipe[cad]'" in done.output


def test_types_of_the_statismo_file(tmp_path: Path) -> None:
    """Scalismo casts arrays to Float and Int and wants fixed-length scalar strings; anything else is not read."""
    model = shape_model("tube")
    export(write_model(model, tmp_path / "out"), tmp_path / "m.h5")
    n, k = len(model.mean), len(model.variances)
    with h5py.File(tmp_path / "m.h5") as file:
        shapes = {
            "representer/points": (3, n), "model/mean": (3 * n,), "model/pcaBasis": (3 * n, k), "model/pcaVariance": (k,),
            "model/noiseVariance": (), "modelinfo/scores": (k, len(model.ids)),
        }  # fmt: skip
        for name, shape in shapes.items():
            assert (file[name].shape, file[name].dtype) == (shape, np.float32), name
        assert (file["representer/cells"].shape, file["representer/cells"].dtype) == ((3, len(model.faces)), np.int32)
        versions = ("version/majorVersion", "version/minorVersion")
        assert [(int(file[v][()]), file[v].dtype) for v in versions] == [(0, np.int32), (9, np.int32)]
        texts = ["modelinfo/build-time", "modelinfo/modelBuilder-0/builderName", "modelinfo/modelBuilder-0/buildTime"]
        for name in [*texts, "modelinfo/modelBuilder-0/dataInfo/URI_0"]:
            assert (file[name].shape, file[name].dtype.kind) == ((), "S"), "fixed length, scalar"
        assert {key: value.dtype.kind for key, value in file["representer"].attrs.items()} == dict.fromkeys(
            ("name", "version", "datasetType"), "S"
        )
        assert {"pointData", "cellData"} <= set(file["representer"])
        np.testing.assert_allclose(file["modelinfo/scores"][:].std(axis=1, ddof=1), 1, atol=1e-5)
        basis = file["model/pcaBasis"][:].astype(float)
        np.testing.assert_allclose(basis.T @ basis, np.eye(k), atol=1e-5)
