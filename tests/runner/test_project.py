from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ssmpipe.runner.project import load_project
from ssmpipe.runner.registry import Registry
from tests.support.toys import GOOD


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


def test_a_role_that_nothing_reads_is_named(tmp_path: Path, scans: Path, registry: Registry) -> None:
    (tmp_path / "marks.json").write_text('{"a": {"tip": [0, 0, 0]}}')
    path = tmp_path / "c.yaml"
    roles = "  roles: {trim: tip, corner1: tip}"
    path.write_text(
        f"name: t\ninput:\n  scans: scans\n  landmarks: marks.json\n{roles}\noutput: out\nanatomy: femur-distal\n"
    )
    (warning,) = (w for w in load_project(path, (), registry).warnings if "roles" in w)
    assert warning.endswith("c.yaml:5: input.roles.corner1: no stage of this chain reads it; did you mean 'corner_1'?")


def test_fewer_scans_than_the_group_needs(tmp_path: Path, scans: Path, registry: Registry) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(GOOD.replace("scans: scans", "scans: [scans/a.ply, scans/b.ply]"))
    (warning,) = load_project(path, (), registry).warnings
    assert warning.endswith(
        "c.yaml:3: input.scans: 2 scans, but group stages need at least 3 (min_shapes); total will not be run; "
        "add scans, or lower min_shapes"
    )
    assert load_project(path, ["min_shapes=2"], registry).warnings == ()
