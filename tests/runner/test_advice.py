"""What runs but is hardly meant is said before it runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from ssmpipe.runner.project import load_project
from ssmpipe.runner.registry import Registry

HEAD = "name: t\ninput: {scans: scans, cohort: cohort.csv}\noutput: out\n"
CUSTOM = "stages: [repair, orient: {mirror: left}, align, %s, parameterize: {%s}]\n"


def advice(tmp_path: Path, registry: Registry, text: str, sides: str = "LRRL") -> list[str]:
    rows = "".join(f"{i},{side}\n" for i, side in zip("abcd", sides, strict=True))
    (tmp_path / "cohort.csv").write_text("id,side\n" + rows)
    (tmp_path / "c.yaml").write_text(HEAD + text)
    warnings = load_project(tmp_path / "c.yaml", (), registry).warnings
    return [w.removeprefix(f"{tmp_path}/") for w in warnings if "group stages need" not in w]


@pytest.mark.usefixtures("scans")
@pytest.mark.parametrize(
    ("later", "options", "warned"),
    [
        ("trim", "topology: cone", True),
        ("trim, smooth", "topology: disk", True),
        ("fill-holes", "topology: closed", True),
        ("smooth, decimate", "topology: cone", False),
        ("trim", "topology: cone, places: own", False),
        ("trim, cut", "topology: tube", False),
        ("trim, cut", "topology: auto", False),
    ],
)
def test_a_reference_that_is_not_cut_like_the_shapes(
    tmp_path: Path, registry: Registry, later: str, options: str, warned: bool
) -> None:
    found = advice(tmp_path, registry, CUSTOM % (later, options))
    assert len(found) == warned
    if warned:
        assert (
            "c.yaml:4: parameterize: places: reference takes poles and corners from the reference as 'align'"
            in found[0]
        )
        assert f"before '{later.split(',')[0]}'; put it before 'align', or set places: own" in found[0]


def test_a_reference_from_a_file_or_places_from_landmarks_are_trusted(
    tmp_path: Path, registry: Registry, scans: Path
) -> None:
    text = CUSTOM % ("trim", "topology: cone")
    assert advice(tmp_path, registry, text.replace("align", "align: {reference: scans/a.ply}")) == []
    (tmp_path / "marks.json").write_text('{"a": {"tip": [0, 0, 0], "back": [1, 0, 0]}}')
    roles = "cohort.csv, landmarks: marks.json, roles: {apex: tip, seam: back}}"
    (tmp_path / "c.yaml").write_text((HEAD + text).replace("cohort.csv}", roles))
    assert not any("places" in w for w in load_project(tmp_path / "c.yaml", (), registry).warnings)


@pytest.mark.usefixtures("scans")
def test_left_and_right_that_stay_as_they_are(tmp_path: Path, registry: Registry) -> None:
    (found,) = advice(tmp_path, registry, "anatomy: closed\n")
    assert "c.yaml:4: orient: mirror: none, but the cohort has left and right shapes; set mirror: left" in found
    assert advice(tmp_path, registry, "anatomy: closed\n", "RRRR") == []
    assert advice(tmp_path, registry, "anatomy: closed\nstages: [orient: {mirror: right}]\n") == []
    assert advice(tmp_path, registry, "anatomy: closed\nstages: [align: {chirality: best-fit}]\n") == []
    assert advice(tmp_path, registry, "anatomy: femur-distal\n") == []
