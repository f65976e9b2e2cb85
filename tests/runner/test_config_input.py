from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.config_problems import ConfigErrors
from ssmpipe.runner.project import load_project
from ssmpipe.runner.registry import Registry
from tests.support.toys import GOOD, tetrahedron


def test_inputs(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (tmp_path / "cohort.csv").write_text("id,side,age\na,left,50\nb,R,60\nz,L,1\n")
    (tmp_path / "marks.json").write_text(json.dumps({"a": {"tip": [0, 0, 0]}}))
    path = tmp_path / "c.yaml"
    text = GOOD.replace("scans: scans", "scans: scans\n  cohort: cohort.csv\n  landmarks: marks.json\n  units: cm")
    path.write_text(text)
    project = load_project(path, (), registry)
    a, b, c, _ = project.sources.values()
    assert (a.side, dict(a.columns), a.landmarks) == ("L", {"age": "50"}, {"tip": (0.0, 0.0, 0.0)})
    assert (b.side, c.side, c.landmarks) == ("R", None, None)
    assert any(w.startswith("c: no row in the cohort table") for w in project.warnings)
    assert any(w.startswith("b: no landmarks") for w in project.warnings)
    assert "cohort table: 1 entry has no scan (z)" in project.warnings
    assert a.load()["mesh"].vertices.max() == 100.0
    assert a.load()["transform"][0, 0] == 10.0


def test_near_misses_of_names_are_told(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (tmp_path / "cohort.csv").write_text("id,side\nA.stl,L\nb,R\nc,R\nd,R\n")
    (tmp_path / "marks.json").write_text(json.dumps({"a": {"Tip": [0, 0, 0]}, "b": {"tip": [0, 0, 0]}, "C": {}}))
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("scans: scans", "scans: scans\n  cohort: cohort.csv\n  landmarks: marks.json"))
    warnings = load_project(path, (), registry).warnings
    assert any("a: no row in the cohort table (it has 'A.stl'; ids are" in w for w in warnings)
    assert any("c: no landmarks in the landmark file (it has 'C'; ids are" in w for w in warnings)
    assert any("d: no landmarks in the landmark file;" in w for w in warnings)
    assert any("'Tip' (1 shape), 'tip' (1 shape) are taken for different landmarks" in w for w in warnings)


def test_scans_from_the_cohort_table(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (tmp_path / "cohort.csv").write_text("id,path\none,scans/a.ply\ntwo,scans/b.ply\n")
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("scans: scans", "cohort: cohort.csv"))
    assert {i: s.path.name for i, s in load_project(path, (), registry).sources.items()} == {
        "one": "a.ply",
        "two": "b.ply",
    }
    for shape_id in ("../x", "..", "/x", ".x", "a b", "x" * 65, "</script>", "con/..", "a\\b"):
        (tmp_path / "cohort.csv").write_text(f"id,path\n{shape_id},scans/a.ply\n")
        with pytest.raises(ConfigErrors, match="cannot serve as shape id"):
            load_project(path, (), registry)


@pytest.mark.parametrize("place", ["../{0}", "/etc/passwd", "scans/../../{0}", "{1}", "scans/a.ply\0.ply"])
def test_a_cohort_table_does_not_lead_out_of_its_folder(
    place: str, tmp_path: Path, scans: Path, registry: Registry
) -> None:
    write_mesh(tmp_path.parent / "other.ply", tetrahedron())
    place = place.format("other.ply", tmp_path.parent / "other.ply")
    (tmp_path / "cohort.csv").write_text(f"id,path\none,{place}\n")
    (tmp_path / "c.yaml").write_text(GOOD.replace("scans: scans", "cohort: cohort.csv"))
    with pytest.raises(ConfigErrors, match="leads out of the folders of table and config"):
        load_project(tmp_path / "c.yaml", (), registry)
    (tmp_path / "cohort.csv").write_text("id,path\none,scans/../scans/a.ply\n")
    assert "one" in load_project(tmp_path / "c.yaml", (), registry).sources


def test_input_problems(tmp_path: Path, scans: Path, problems: Callable[..., list[str]]) -> None:
    def one(line: str) -> str:
        (found,) = problems(GOOD.replace("scans: scans", line))
        return found

    (tmp_path / "empty").mkdir()
    (tmp_path / "two").mkdir()
    write_mesh(tmp_path / "two" / "a.stl", tetrahedron())
    write_mesh(tmp_path / "two" / "b c.stl", tetrahedron())
    (tmp_path / "text.txt").write_text("x")
    (tmp_path / "side.csv").write_text("id,side\na,up\n")
    assert one("scans: empty").startswith("c.yaml:3: input.scans: no scans in the folder empty")
    assert "no scans match none/*.ply" in one("scans: none/*.ply")
    assert "the scan none.ply does not exist" in one("scans: none.ply")
    assert "text.txt is not a surface file" in one("scans: [text.txt]")
    assert "'b c.stl' cannot serve as shape id" in one("scans: two")
    assert "two scans have the id 'a'" in one("scans: [scans/a.ply, two/a.stl]")
    assert one("scans: scans\n  cohort: side.csv").startswith(
        "c.yaml:3: input.scans: cohort table, shape 'a': side is 'up'"
    )
    assert one("scans: scans\n  cohort: none.csv").startswith("c.yaml:4: input.cohort: none.csv cannot be read")
    assert one("scans: scans\n  roles: {apex: x}").startswith("c.yaml:4: input.roles: names landmarks")
    assert "no scans given" in one("units: mm")


def test_a_role_for_a_landmark_that_no_shape_has(tmp_path: Path, problems: Callable[..., list[str]]) -> None:
    (tmp_path / "marks.json").write_text('{"a": {"tip": [0, 0, 0]}, "z": {"top": [0, 0, 0]}}')
    roles = "\n  landmarks: marks.json\n  roles:\n    trim: tipp\n"
    (found,) = problems(GOOD.replace("\noutput", f"{roles}output"))
    assert found == "c.yaml:6: input.roles.trim: no shape has a landmark 'tipp'; did you mean 'tip'?"


def test_all_missing_files_at_once_also_with_bad_keys(tmp_path: Path, problems: Callable[..., list[str]]) -> None:
    text = """\
nam: toys
input:
  scans: [scans, none.ply, no/*.stl]
  cohort: cohort.csv
  landmarks: marks.json
  unit: mm
output: out
stages: [grow]
"""
    found = problems(text)
    starts = (
        "c.yaml:1: nam:",
        "c.yaml:6: input.unit: unknown key; did you mean 'units'?",
        "c.yaml:4: input.cohort: cohort.csv",
    )
    for start in (
        *starts,
        "c.yaml:5: input.landmarks: ",
        "c.yaml:3: input.scans: the scan none.ply",
        "c.yaml:3: input.scans: no scans",
    ):
        assert any(p.startswith(start) for p in found), (start, found)
    (tmp_path / "cohort.csv").write_text("id,path\none,x.ply\ntwo,y.ply\n")
    (found_,) = problems(GOOD.replace("scans: scans", "cohort: cohort.csv"))
    assert "cohort table: 2 scans missing: " in found_
    assert "x.ply (shape 'one')" in found_
    assert "y.ply (shape 'two')" in found_
