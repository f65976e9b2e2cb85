from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.project import load_project
from ssmpipe.runner.registry import Registry
from tests.support.toys import GOOD


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


def test_options_that_are_files_count_by_content(tmp_path: Path, scans: Path, registry: Registry) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("  - total", "  - shift: {reference: scans/a.ply}\n  - total"))
    step = load_project(path, (), registry).steps[1]
    assert step.options["reference"].startswith("file:")
    assert str(tmp_path) not in json.dumps(dict(step.options))
    assert step.files["reference"][1] == str(scans / "a.ply")


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
