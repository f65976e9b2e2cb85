from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ssmpipe.runner.fingerprint import VOLATILE, file_digest
from ssmpipe.runner.manifest import FILE, Manifest, Output, Request, decide, read_manifest

REQUEST = Request("grow", 1, {"factor": 2.0, "note": ""}, {"mesh": "abc", "info": None}, 0, "a")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mesh.ply").write_text("a mesh")
    (tmp_path / "history.csv").write_text("1")
    outputs = {
        "mesh": Output("trimesh", {"mesh.ply": file_digest(tmp_path / "mesh.ply")}),
        "history": Output("table", {"history.csv": VOLATILE}),
    }
    Manifest("grow", REQUEST, outputs, "first run", {"n_faces": 4}, ("look",), {"numpy": "2"}, {"mesh": "scan"}).write(
        tmp_path / FILE
    )
    return tmp_path


def reason(folder: Path, request: Request = REQUEST, *, force: bool = False) -> str:
    decision = decide(read_manifest(folder), request, folder, force=force)
    assert decision.run == (decision.reason != "up to date")
    return decision.reason


def test_round_trip(folder: Path) -> None:
    manifest = read_manifest(folder)
    assert manifest is not None
    assert manifest.request == REQUEST
    assert manifest.metrics == {"n_faces": 4}
    assert manifest.warnings == ("look",)
    text = (folder / FILE).read_text()
    manifest.write(folder / FILE)
    assert (folder / FILE).read_text() == text


def test_up_to_date(folder: Path) -> None:
    assert reason(folder) == "up to date"


def test_first_run(tmp_path: Path) -> None:
    assert reason(tmp_path) == "first run"


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"schema": 99}', "null"])
def test_unreadable_manifest_counts_as_none(folder: Path, text: str) -> None:
    (folder / FILE).write_text(text)
    assert read_manifest(folder) is None
    assert reason(folder) == "first run"


def test_forced(folder: Path) -> None:
    assert reason(folder, force=True) == "forced"


def test_config_changed_names_the_keys(folder: Path) -> None:
    assert (
        reason(folder, replace(REQUEST, config={"factor": 3.0, "note": "", "new": None}))
        == "config changed: factor, new"
    )


def test_input_changed_names_the_slots(folder: Path) -> None:
    assert reason(folder, replace(REQUEST, inputs={"mesh": "abd", "info": None})) == "input changed: mesh"
    assert reason(folder, replace(REQUEST, inputs={"mesh": "abc", "info": "x"})) == "input changed: info"


def test_version_changed(folder: Path) -> None:
    assert reason(folder, replace(REQUEST, version=2)) == "stage version changed: 1 -> 2"


def test_seed_changed(folder: Path) -> None:
    assert reason(folder, replace(REQUEST, seed=5)) == "seed changed: 0 -> 5"


def test_output_missing(folder: Path) -> None:
    (folder / "mesh.ply").unlink()
    assert reason(folder) == "output missing: mesh.ply"


def test_output_modified(folder: Path) -> None:
    (folder / "mesh.ply").write_text("b mesh")
    assert reason(folder) == "output modified: mesh.ply"


def test_volatile_output_may_change_but_must_exist(folder: Path) -> None:
    (folder / "history.csv").write_text("2")
    assert reason(folder) == "up to date"
    (folder / "history.csv").unlink()
    assert reason(folder) == "output missing: history.csv"
