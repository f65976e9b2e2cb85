from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.config import ConfigErrors, load_project
from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.registry import Registry
from tests.support.toys import tetrahedron

GOOD = """\
name: toys
input:
  scans: scans
output: out
stages:
  - grow: {factor: 3}
  - total
"""


@pytest.fixture
def problems(tmp_path: Path, scans: Path, registry: Registry) -> Callable[..., list[str]]:
    def find(text: str, *overrides: str) -> list[str]:
        path = tmp_path / "c.yaml"
        path.write_text(text)
        try:
            load_project(path, overrides, registry)
        except ConfigErrors as error:
            return [p.replace(str(tmp_path) + "/", "") for p in error.problems]
        return []

    return find


def test_good(problems: Callable[..., list[str]]) -> None:
    assert problems(GOOD) == []


def test_all_problems_at_once_each_with_its_line(problems: Callable[..., list[str]]) -> None:
    text = """\
nam: toys
input:
  scan: scans
  units: inch
output: out
stages:
  - grow: {facter: 3}
  - shrink
  - shift:
      noise: -1
      reference: 5
seed: -1
"""
    found = problems(text)
    expected = [
        "c.yaml:1: nam: unknown key; did you mean 'name'?",
        "c.yaml:1: name: is missing",
        "c.yaml:3: input.scan: unknown key; did you mean 'scans'?",
        "c.yaml:4: input.units: should be 'mm', 'cm', 'm', 'um' or 'none' (got \"inch\")",
        "c.yaml:7: stages.0.grow.facter: unknown key; did you mean 'factor'?",
        "c.yaml:10: stages.2.shift.noise: should be greater than or equal to 0 (got -1)",
        "c.yaml:11: stages.2.shift.reference: should be a valid string (got 5)",
        "c.yaml:12: seed: should be greater than or equal to 0 (got -1)",
    ]
    assert sorted(p for p in found if ": stages.1: " not in p) == sorted(expected)
    (unknown,) = (p for p in found if "stages.1" in p)
    assert unknown.startswith("c.yaml:8: stages.1: unknown stage 'shrink'")


def test_types_are_strict(problems: Callable[..., list[str]]) -> None:
    (found,) = problems(GOOD.replace("factor: 3", "factor: 1.5 mm"))
    assert found == 'c.yaml:6: stages.0.grow.factor: should be a valid number (got "1.5 mm")'
    (found,) = problems(GOOD + "seed: 1.5\n")
    assert found.startswith("c.yaml:8: seed: should be a valid integer")


def test_union_branches_are_one_problem(problems: Callable[..., list[str]]) -> None:
    (found,) = problems(GOOD.replace("scans: scans", "scans: {a: b}"))
    assert found == 'c.yaml:3: input.scans: should be a valid string or should be a valid array (got {"a": "b"})'


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ("[{grow: {}, total: {}}]", "stages.0: write one stage per entry"),
        ("[grow, grow]", "'grow' occurs twice; tell them apart: grow: {id: grow-2}"),
        ("[{grow: 5}]", "grow: needs options as a mapping (got 5)"),
        ("[{grow: {skip: maybe}}]", "grow.skip: must be true or false"),
        ("[{grow: {id: 'a b'}}]", "grow.id: must be a short name"),
        ("[{grow: {from: {uv: shift}}}]", "grow.from.uv: grow reads no such slot; known: mesh"),
        ("[{grow: {from: {mesh: shift}}}]", "to read 'mesh' from 'shift'"),
        ("[{grow: {after: shift}}]", "`after` needs an anatomy"),
        ("[fit]", "stage 'fit' needs 'samples', and no stage before it makes that"),
        ("[]", "the chain is empty; set anatomy: femur-distal | disk"),
        ("5", "stages: should be a valid array"),
    ],
)
def test_chain_problems(problems: Callable[..., list[str]], stages: str, message: str) -> None:
    found = problems(f"name: t\ninput: {{scans: scans}}\noutput: out\nstages: {stages}\n")
    assert len(found) == 1
    assert found[0].startswith("c.yaml:4: ")
    assert message in found[0]


def test_repeats_have_ids(tmp_path: Path, scans: Path, registry: Registry) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("  - total", "  - grow: {id: grow-2, from: {mesh: grow}}\n  - total"))
    project = load_project(path, ["stages.grow-2.factor=5"], registry)
    assert [(s.id, s.stage.name, s.options.get("factor")) for s in project.steps[:2]] == [
        ("grow", "grow", 3.0),
        ("grow-2", "grow", 5.0),
    ]


# --- presets ---


def preset(
    tmp_path: Path, registry: Registry, stages: str, anatomy: str = "femur-distal", *overrides: str
) -> list[tuple]:
    path = tmp_path / "c.yaml"
    path.write_text(f"name: t\ninput: {{scans: scans}}\noutput: out\nanatomy: {anatomy}\nstages: {stages}\n")
    project = load_project(path, overrides, registry)
    return [(s.id, dict(s.options)) for s in project.steps]


def test_presets_run_with_the_stages_that_exist(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (scans / "outline.csv").write_text("x,y\n0,0\n1,0\n0,1\n")
    for name, one in PRESETS.items():
        assert [i for i, _ in preset(tmp_path, registry, "[]", name)] == [stage for stage, _ in one.stages]


def test_disks_have_no_sides(tmp_path: Path, scans: Path, registry: Registry) -> None:
    assert dict(preset(tmp_path, registry, "[]", "disk"))["align"]["check_mirror"] is False
    assert dict(preset(tmp_path, registry, "[{align: {check_mirror: true}}]", "disk"))["align"]["check_mirror"] is True
    assert dict(preset(tmp_path, registry, "[]"))["align"]["check_mirror"] is True


def test_merge_skip_and_insert(tmp_path: Path, scans: Path, registry: Registry) -> None:
    text = "[{decimate: {n_faces: 5000}}, {smooth: {skip: true}}, {grow: {after: repair}}, {grow: {id: again, after: fit}}]"
    steps = preset(tmp_path, registry, text)
    names = [i for i, _ in steps]
    assert names[:5] == ["repair", "grow", "orient", "trim", "decimate"]
    assert names[names.index("fit") + 1] == "again"
    assert dict(steps)["decimate"]["n_faces"] == 5000
    assert "smooth" not in names


def test_bare_stages_key_means_none(tmp_path: Path, scans: Path, registry: Registry) -> None:
    assert len(preset(tmp_path, registry, "")) == 13


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ("[grow]", "'grow' is not part of the chain of femur-distal; say where it goes"),
        ("[{grow: {after: smoth}}]", "grow.after: no such step 'smoth'; did you mean 'smooth'?"),
        ("[{smooth: {after: fit}}]", "'smooth' is in the chain already; give the second one an id"),
        ("[smooth, {smooth: {}}]", "'smooth' is given twice, first in c.yaml:5"),
        ("[{decimate: {n_face: 5}}]", "stages.0.decimate.n_face: unknown key; did you mean 'n_faces'?"),
    ],
)
def test_preset_problems(problems: Callable[..., list[str]], stages: str, message: str) -> None:
    (found,) = problems(f"name: t\ninput: {{scans: scans}}\noutput: out\nanatomy: femur-distal\nstages: {stages}\n")
    assert found.startswith("c.yaml:5: ")
    assert message in found


def test_unknown_anatomy(problems: Callable[..., list[str]]) -> None:
    (found,) = problems("name: t\ninput: {scans: scans}\noutput: out\nanatomy: femur-distel\n")
    assert found == "c.yaml:4: anatomy: unknown 'femur-distel'; did you mean 'femur-distal'?"


# --- --set ---


def test_overrides(tmp_path: Path, scans: Path, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD)
    other = tmp_path / "elsewhere"
    (other / "more").mkdir(parents=True)
    for name in "xyz":
        write_mesh(other / "more" / f"{name}.stl", tetrahedron())
    monkeypatch.chdir(other)
    project = load_project(
        path,
        ["input.scans=more", "seed=7", "stages.grow.factor=1e1", "stages.total.weight=2", "limits.timeout_s=null"],
        registry,
    )
    assert sorted(project.sources) == ["x", "y", "z"]
    assert project.config.seed == 7
    assert project.config.limits.timeout_s is None
    assert [s.options.get("factor", s.options.get("weight")) for s in project.steps] == [10.0, 2.0]
    assert project.out == tmp_path / "out"
    assert load_project(path, ["output=here"], registry).out == other / "here"


def test_override_problems_name_the_option(problems: Callable[..., list[str]]) -> None:
    assert problems(GOOD, "sed=3") == ["--set sed=3: sed: unknown key; did you mean 'seed'?"]
    (found,) = problems(GOOD, "stages.grow.factr=3")
    assert found == "--set stages.grow.factr=3: stages.0.grow.factr: unknown key; did you mean 'factor'?"
    (found,) = problems(GOOD, "stages.grov.factor=3")
    assert found.startswith("--set stages.grov.factor=3: stages.2: unknown stage 'grov'; did you mean 'grow'?")


# --- inputs ---


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


def test_options_that_are_files_count_by_content(tmp_path: Path, scans: Path, registry: Registry) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("  - total", "  - shift: {reference: scans/a.ply}\n  - total"))
    step = load_project(path, (), registry).steps[1]
    assert step.options["reference"].startswith("file:")
    assert str(tmp_path) not in json.dumps(dict(step.options))
    assert step.files["reference"][1] == str(scans / "a.ply")


def test_a_role_that_nothing_reads_is_named(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (tmp_path / "marks.json").write_text('{"a": {"tip": [0, 0, 0]}}')
    path = tmp_path / "c.yaml"
    roles = "  roles: {trim: tip, corner1: tip}"
    path.write_text(
        f"name: t\ninput:\n  scans: scans\n  landmarks: marks.json\n{roles}\noutput: out\nanatomy: femur-distal\n"
    )
    (warning,) = (w for w in load_project(path, (), registry).warnings if "roles" in w)
    assert warning.endswith("c.yaml:5: input.roles.corner1: no stage of this chain reads it; did you mean 'corner_1'?")


# --- names of shapes and landmarks, sizes ---


def test_a_reference_that_is_no_shape(problems: Callable[..., list[str]]) -> None:
    text = GOOD.replace("  - total", "  - shift:\n      reference: largst\n  - total")
    (found,) = problems(text)
    assert found == ("c.yaml:8: stages.1.shift.reference: there is no shape or file 'largst'; did you mean 'largest'?")
    assert problems(text.replace("largst", "b")) == []
    (found,) = problems(text, "stages.shift.reference=e")
    assert found.endswith("there is no shape or file 'e'; known: a, b, c, d, largest")


def test_references_of_the_real_stages(problems: Callable[..., list[str]]) -> None:
    head = "name: t\ninput: {scans: scans}\noutput: out\nanatomy: disk\nstages:\n"
    found = problems(head + "  - align: {reference: medoit}\n  - optimize:\n      reference: nearest-to-men\n")
    assert found == [
        "c.yaml:6: stages.0.align.reference: there is no shape or file 'medoit'; did you mean 'medoid'?",
        "c.yaml:8: stages.1.optimize.reference: there is no shape 'nearest-to-men'; did you mean 'nearest-to-mean'?",
    ]
    found = problems(head + "  - align: {reference: x, n_points: 1}\n")
    assert [p.split(": ")[1] for p in found] == ["stages.0.align.n_points", "stages.0.align.reference"]
    assert problems(head + "  - align: {reference: a}\n  - optimize: {reference: none}\n") == []


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            "n_coefficients: [3, 8]",
            "optimize.n_coefficients: needs one number (curves) or two (surfaces), each at least ",
        ),
        (
            "n_coefficients: [6, 6], degree: 5",
            "each at least degree + 2 = 7; raise it, or lower optimize.degree (got [6, 6])",
        ),
        ("n_coefficients: []", "optimize.n_coefficients: needs one number"),
        ("landmarks: [51, 2]", "optimize.landmarks: needs one number (curves) or two (surfaces), each at least 3"),
        ("landmarks: [9, 9, 9]", "optimize.landmarks: needs one number"),
        ("n_coefficients: [12]", "optimize.landmarks has 2 numbers and optimize.n_coefficients has 1; give both one"),
    ],
)
def test_counts_that_are_too_small(problems: Callable[..., list[str]], options: str, text: str) -> None:
    (found,) = problems(
        f"name: t\ninput: {{scans: scans}}\noutput: out\nanatomy: disk\nstages:\n  - optimize: {{{options}}}\n"
    )
    assert found.startswith("c.yaml:6: stages.0.optimize")
    assert text in found


def test_fewer_scans_than_the_group_needs(tmp_path: Path, scans: Path, registry: Registry) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("scans: scans", "scans: [scans/a.ply, scans/b.ply]"))
    (warning,) = load_project(path, (), registry).warnings
    assert warning.endswith(
        "c.yaml:3: input.scans: 2 scans, but group stages need at least 3 (min_shapes); total will not be run; "
        "add scans, or lower min_shapes"
    )
    assert load_project(path, ["min_shapes=2"], registry).warnings == ()


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
