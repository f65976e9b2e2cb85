"""Every kind of artifact comes back as it was, and the same artifact gives the same bytes."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ssmpipe.contract import Landmarks, ShapeInfo, Table
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.core.spline.surface import BSplineSurface
from ssmpipe.io.codecs import KINDS, load_artifact, save_artifact

RNG = np.random.default_rng(3)
GRID = (3, 4)
FACES = np.array([[0, 1, 4], [1, 5, 4], [1, 2, 5]])


def correspondence() -> Correspondence:
    def a(*shape: int) -> np.ndarray:
        return RNG.normal(size=shape)

    return Correspondence(
        ("femur_01", "fémur_02"), a(2, 12, 3), a(2, 12, 3), a(2, 12, 3), a(2, 12, 3), a(2, 4, 4), a(2), a(2, 12, 2), GRID,
        FACES, "disk", -1, a(2), 1e-3 / 3, a(1), a(1), a(2, 4, 4, 2),
    )  # fmt: skip


def model() -> ShapeModel:
    modes = np.linalg.qr(RNG.normal(size=(36, 2)))[0].T.reshape(2, 12, 3)
    return ShapeModel(
        ("a", "b", "c"),
        RNG.normal(size=(12, 3)),
        modes,
        np.array([4.0, 1.0]),
        RNG.normal(size=(3, 2)),
        GRID,
        FACES,
        "disk",
    )


KNOTS = np.array([0, 0, 0, 1 / 3, 1, 1, 1])
ARTIFACTS: dict[str, Any] = {
    "trimesh": TriMesh(RNG.normal(size=(12, 3)) / 3, FACES),
    "outline": Outline(RNG.normal(size=(5, 2)) / 3, True),
    "landmarks": Landmarks({"MFH": RNG.normal(size=3), "é": np.array([0.1, 1e-17])}, {"apex": "MFH"}),
    "transform": RNG.normal(size=(4, 4)) * 1e5,
    "info": ShapeInfo("femur_01", "L", {"group": "a", "age": "007"}),
    "seam": Seam("cone", np.array([[0, 4], [1, 5]]), (7,)),
    "uv": RNG.uniform(size=(12, 2)),
    "samples": RNG.normal(size=(5, 6, 3)),
    "surface": BSplineSurface((2, 2), KNOTS, KNOTS, RNG.normal(size=(4, 4, 3))),
    "correspondence": correspondence(),
    "model": model(),
    "table": Table({"id": ["01", "b;c"], "x": [1 / 3, float("nan")], "n": [1, 2]}, "lengths in mm"),
    "arrays": {"ids": np.array(["a", "fémur"]), "distance": RNG.normal(size=(2, 5))},
    "json": {"a": [1, 2.5, None], "b": {"c": "text"}},
    "meshes": {
        "mean": TriMesh(np.eye(3), np.array([[0, 1, 2]])),
        "mode_1": TriMesh(np.eye(3), np.array([[0, 2, 1]])),
        "mode_2": Outline(RNG.normal(size=(5, 2)), False),
    },
}


def same(a: Any, b: Any) -> bool:
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, k), getattr(b, k)) for k in a.__dataclass_fields__)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, np.ndarray):
        return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(type(a) is type(b) and (a == b or (a != a and b != b)))


def test_there_is_an_example_of_each_kind() -> None:
    assert set(ARTIFACTS) == set(KINDS)


@pytest.mark.parametrize("kind", ARTIFACTS)
def test_round_trip_is_exact(kind: str, tmp_path: Path) -> None:
    files = save_artifact(kind, "thing", ARTIFACTS[kind], tmp_path)
    assert sorted(files) == sorted(p.name for p in tmp_path.iterdir())
    assert same(ARTIFACTS[kind], load_artifact(kind, "thing", tmp_path, files))


@pytest.mark.parametrize("kind", ARTIFACTS)
def test_bytes_repeat(kind: str, tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
        files = save_artifact(kind, "thing", ARTIFACTS[kind], folder)
        if kind in ("model", "uv"):
            time.sleep(1.1)  # HDF5 and zip count in seconds
    assert [(folders[0] / f).read_bytes() for f in files] == [(folders[1] / f).read_bytes() for f in files]


@pytest.mark.parametrize("kind", ARTIFACTS)
def test_damaged_and_missing_files_are_refused(kind: str, tmp_path: Path) -> None:
    files = save_artifact(kind, "thing", ARTIFACTS[kind], tmp_path)
    (tmp_path / files[0]).write_bytes(b"\xff\xfe\x00 no")
    with pytest.raises(ArtifactError):
        load_artifact(kind, "thing", tmp_path, files)
    (tmp_path / files[0]).unlink()
    with pytest.raises(ArtifactError, match="missing"):
        load_artifact(kind, "thing", tmp_path, files)


@pytest.mark.parametrize("kind", ["landmarks", "transform", "info"])
def test_json_of_another_kind_is_refused(kind: str, tmp_path: Path) -> None:
    (tmp_path / "thing.json").write_text('{"x": 1}')
    with pytest.raises(ArtifactError, match=r"thing\.json"):
        load_artifact(kind, "thing", tmp_path, ["thing.json"])


def test_missing_array_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "correspondence.npz", points=np.zeros(3))
    with pytest.raises(ArtifactError, match="has no array ids, grid"):
        load_artifact("correspondence", "correspondence", tmp_path, ["correspondence.npz"])


def test_interface_arrays_of_the_correspondence(tmp_path: Path) -> None:
    save_artifact("correspondence", "correspondence", ARTIFACTS["correspondence"], tmp_path)
    with np.load(tmp_path / "correspondence.npz", allow_pickle=False) as data:
        assert set(data.files) == {
            "ids", "points", "points_scan", "initial_points", "initial_points_scan", "transform", "scale", "parameters",
            "grid", "faces", "topology", "reference", "description_length", "lambda_cut", "eigenvalues_initial",
            "eigenvalues", "coefficients",
        }  # fmt: skip
        assert data["ids"].tolist() == ["femur_01", "fémur_02"]
        assert str(data["topology"]) == "disk"
        assert data["grid"].tolist() == list(GRID)


def test_pickles_are_neither_written_nor_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "uv.npz", uv=np.array([{}], dtype=object))
    with pytest.raises(ArtifactError, match="Python objects"):
        load_artifact("uv", "uv", tmp_path, ["uv.npz"])


def test_npz_that_declares_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    member = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "uv.npz", "w") as archive:
        archive.writestr("uv.npy", member.getvalue() + bytes(8))
    with pytest.raises(ArtifactError, match=r"'uv\.npy' declares 8000000000000 bytes, 8 are there"):
        load_artifact("uv", "uv", tmp_path, ["uv.npz"])


def test_npz_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssmpipe.io.arrays.MAX_BYTES", 10_000)
    np.savez_compressed(tmp_path / "uv.npz", uv=np.zeros((1000, 2)))
    with pytest.raises(ArtifactError, match="declares 16"):
        load_artifact("uv", "uv", tmp_path, ["uv.npz"])


def test_files_outside_the_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    with pytest.raises(ArtifactError, match="outside"):
        load_artifact("json", "x", tmp_path / "inner", ["../x.json"])
    with pytest.raises(ArtifactError, match="cannot be a file name"):
        save_artifact("meshes", "m", {"../x": ARTIFACTS["trimesh"]}, tmp_path)
    with pytest.raises(ArtifactError, match="unknown kind"):
        save_artifact("picture", "m", None, tmp_path)


@pytest.mark.parametrize("matrix", [np.eye(3), np.full((4, 4), np.nan)])
def test_transform_must_be_a_finite_matrix(matrix: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="4 x 4"):
        save_artifact("transform", "transform", matrix, tmp_path)


def test_surface_must_fit_its_knots(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", degree=2, knots_u=KNOTS, knots_v=KNOTS[1:], control_points=np.zeros((4, 4, 3)))
    with pytest.raises(ArtifactError, match="knots_v: got 6 knots"):
        load_artifact("surface", "s", tmp_path, ["s.npz"])
    np.savez(tmp_path / "s.npz", degree=2, knots_u=KNOTS, knots_v=KNOTS, control_points=np.zeros((4, 4, 3)))
    assert load_artifact("surface", "s", tmp_path, ["s.npz"]).degree == (2, 2)


def test_statismo_layout_rebuilds_a_shape(tmp_path: Path) -> None:
    """Read the file as a Scalismo user would: mean + basis * sd * score, in float32."""
    m = ARTIFACTS["model"]
    save_artifact("model", "model", m, tmp_path)
    with h5py.File(tmp_path / "model.h5") as file:
        assert file["version/minorVersion"][()] == 9
        assert file["representer"].attrs["datasetType"] == b"POLYGON_MESH"
        assert file["representer/points"].shape == (3, 12)
        assert file["representer/cells"].dtype == np.int32
        assert np.array_equal(file["representer/cells"][:].T, m.faces)
        basis, variance = file["model/pcaBasis"][:], file["model/pcaVariance"][:]
        scores = file["modelinfo/scores"][:]
        assert np.allclose(basis.T @ basis, np.eye(2), atol=1e-6)
        shape = (file["model/mean"][:] + basis @ (np.sqrt(variance) * scores[:, 1])).reshape(-1, 3)
        assert file["modelinfo/modelBuilder-0/dataInfo/URI_2"][()] == b"c"
    assert np.allclose(shape, m.instance(m.scores[1]), atol=1e-5)


def test_statismo_of_a_closed_plane_curve_is_a_line_mesh(tmp_path: Path) -> None:
    m = ShapeModel(
        ("a",),
        np.ones((5, 2)),
        np.zeros((1, 5, 2)),
        np.ones(1),
        np.ones((1, 1)),
        (5,),
        np.zeros((0, 3), int),
        "curve-closed",
    )
    save_artifact("model", "model", m, tmp_path)
    with h5py.File(tmp_path / "model.h5") as file:
        assert file["representer"].attrs["datasetType"] == b"LINE_MESH"
        assert file["representer/cells"][:, -1].tolist() == [4, 0]
        assert file["representer/points"][2].tolist() == [0] * 5
