"""One stage on one file: options, sidecars, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from ssmpipe.cli import main
from ssmpipe.io.meshes import read_mesh, write_mesh
from tests.support.toys import TOY, tetrahedron

Call = Callable[..., Result]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Call:
    monkeypatch.setenv("SSMPIPE_STAGES", str(TOY))

    def invoke(*args: object) -> Result:
        return CliRunner().invoke(main, [str(a) for a in args])

    return invoke


@pytest.fixture
def bone(tmp_path: Path) -> Path:
    write_mesh(tmp_path / "bone.stl", tetrahedron())
    return tmp_path / "bone.stl"


def test_mesh_in_mesh_out_into_a_new_folder(call: Call, bone: Path) -> None:
    out = bone.parent / "new" / "deep" / "bone.ply"
    result = call("grow", bone, out, "--factor", "3")
    assert result.exit_code == 0, result.output
    assert read_mesh(out).vertices.max() == 30.0
    assert "n_faces: 4" in result.output
    beside = json.loads(out.with_name("bone.ply.json").read_text())
    assert set(beside) == {"info", "landmarks", "transform"}
    assert sorted(p.name for p in out.parent.iterdir()) == ["bone.ply", "bone.ply.json"]


def test_sidecars_are_read_back(call: Call, bone: Path) -> None:
    marks = bone.with_name("marks.json")
    marks.write_text(json.dumps({"bone": {"tip": [1, 2, 3]}}))
    write_mesh(bone.with_name("ref.ply"), tetrahedron(10, 100))
    first, second = bone.with_name("one.ply"), bone.with_name("two.ply")
    options = ("--landmarks", marks, "--role", "apex=tip", "--reference", bone.with_name("ref.ply"))
    assert call("shift", bone, first, *options).exit_code == 0
    result = call("shift", first, second, "--reference", bone.with_name("ref.ply"), "--need", "apex")
    assert result.exit_code == 0, result.output
    beside = json.loads(second.with_name("two.ply.json").read_text())
    assert beside["landmarks"]["content"] == {"points": {"tip": [101.0, 102.0, 103.0]}, "roles": {"apex": "tip"}}
    np.testing.assert_allclose(np.array(beside["transform"]["content"])[:3, 3], 100.0)
    assert beside["info"]["content"]["id"] == "bone"


@pytest.mark.parametrize(
    ("args", "code", "text"),
    [
        (("grow", "none.stl", "x.ply"), 3, "there is no file"),
        (("grow", "bone.stl", "x.txt"), 2, "x.txt: this stage needs a file of type"),
        (("grow", "bone.stl", "x.ply", "--factor", "-1"), 2, "--factor: should be greater than 0 (got -1)"),
        (("grow", "bone.stl", "x.ply", "--factor", "big"), 2, '--factor: should be a valid number (got "big")'),
        (("grow", "bone.stl", "x.ply", "--factr", "1"), 2, "--factor"),
        (("grow", "bone.stl", "x.ply", "--refuse", "[bone]"), 3, "the mesh has 2 components; try: keep the largest"),
        (("shift", "bone.stl", "x.ply"), 2, "--reference FILE is needed"),
        (("shift", "bone.stl", "x.ply", "--reference", "bone.stl", "--role", "a=b", "--need", "a"), 3, "landmark 'b'"),
        (("fit", "bone.stl", "x.npz"), 3, "samples is missing"),
        (("total", "none", "x"), 3, "there is no folder"),
    ],
)
def test_refusals(
    call: Call, bone: Path, monkeypatch: pytest.MonkeyPatch, args: tuple[str, ...], code: int, text: str
) -> None:
    monkeypatch.chdir(bone.parent)
    result = call(*args)
    assert result.exit_code == code, result.output
    assert text in result.output
    assert "Traceback" not in result.output
    assert sorted(p.name for p in bone.parent.iterdir()) == ["bone.stl"]


def test_hostile_sidecar(call: Call, bone: Path) -> None:
    bone.with_name("bone.stl.json").write_text("[1, 2]")
    result = call("grow", bone, bone.with_name("x.ply"))
    assert (result.exit_code, "bone.stl.json was not written by ssmpipe" in result.output) == (3, True)


def test_group_stage_on_a_folder(call: Call, scans: Path, tmp_path: Path) -> None:
    result = call("total", scans, tmp_path / "result", "--weight", "2")
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in (tmp_path / "result").iterdir()) == ["history.csv", "mean.ply", "shapes.json"]
    mean = np.mean([read_mesh(p).vertices for p in sorted(scans.iterdir())], axis=0)
    np.testing.assert_allclose(read_mesh(tmp_path / "result" / "mean.ply").vertices, 2 * mean)
    (tmp_path / "empty").mkdir()
    result = call("total", tmp_path / "empty", tmp_path / "r2")
    assert (result.exit_code, "no files with 'mesh'" in result.output) == (3, True)


def test_names_with_spaces_keep_shapes_apart(call: Call, bone: Path) -> None:
    marks = bone.with_name("marks.json")
    marks.write_text(json.dumps({name: {"tip": [1, 2, 3]} for name in ("patient 1", "patient 2")}))
    write_mesh(bone.with_name("ref.ply"), tetrahedron(10, 100))
    for name in ("patient 1", "patient 2"):
        out = bone.parent / "moved" / f"{name}.ply"
        options = ("--landmarks", marks, "--reference", bone.with_name("ref.ply"))
        assert call("shift", bone.rename(bone.with_name(f"{name}.stl")), out, *options).exit_code == 0
        bone = bone.with_name(f"{name}.stl")
    result = call("total", bone.parent / "moved", bone.parent / "sum")
    assert result.exit_code == 0, result.output
    assert "2 shapes; results are in" in result.output


def test_landmarks_far_from_the_file_are_refused(call: Call, bone: Path) -> None:
    marks, out = bone.with_name("marks.json"), bone.with_name("x.ply")
    marks.write_text(json.dumps({"bone": {"tip": [0, 0, -50.0], "top": [0, 0, -7.0]}}))
    result = call("shift", bone, out, "--landmarks", marks, "--reference", bone)
    assert result.exit_code == 3, result.output
    assert "bone, shift, " in result.output
    assert (
        "landmark 'tip' is 50.0 mm away from the surface, at most 20 is accepted; try: give landmarks of"
        in result.output
    )
    assert not out.exists()
    marks.write_text(json.dumps({"bone": {"top": [0, 0, -7.0]}}))
    result = call("shift", bone, out, "--landmarks", marks, "--reference", bone)
    assert (result.exit_code, "warning: landmark 'top' is 7.0 mm away" in result.output) == (0, True)


def test_a_file_in_metres_is_noticed(call: Call, bone: Path) -> None:
    write_mesh(bone, tetrahedron(0.4))
    result = call("grow", bone, bone.with_name("x.ply"))
    assert (result.exit_code, "bounding box diagonal is 0.693; stages take lengths as mm" in result.output) == (0, True)
