from __future__ import annotations

import re

import numpy as np
import pytest

from ssmpipe.core.arrays import Floats
from ssmpipe.report.payload import cohort_columns, groups_of, landmark_places
from ssmpipe.report.section import ReportData
from ssmpipe.report.sections import quality, scores, shapes
from ssmpipe.report.sections.viewer import render as render_viewer
from tests.support.small_run import SmallRun, small_run


@pytest.fixture(scope="module")
def run() -> SmallRun:
    return small_run()


def text_of(html: str) -> str:
    return re.sub(r"<[^>]+>", " ", html)


def test_the_table_of_patients_is_worst_first_and_linked(run: SmallRun) -> None:
    pages = {i: f"report/{i}.html" for i in run.model.ids}
    section = quality.render(ReportData(**run.arguments(), pages=pages))
    assert section is not None
    named = re.findall(r'<th scope="row"><a href="report/([^"]+)\.html">([^<]+)</a>', section.html)
    assert [a for a, _ in named] == list(run.quality.columns["id"]) == [b for _, b in named]
    assert "report/P01_left.html" in shapes.render(ReportData(**run.arguments(), pages=pages)).html  # type: ignore[union-attr]
    shares = [float(x) for x in re.findall(r"<td>([\d.]+) %</td>", section.html)]
    assert shares == sorted(shares, reverse=True)


def test_without_units_no_millimetre_is_said(run: SmallRun) -> None:
    from ssmpipe.report.build import build_report

    arguments = run.arguments()
    record = dict(arguments["record"])
    record["config"] = {**record["config"], "input": {"units": "none"}}
    record["cohort_stages"] = [
        {
            "stage": "optimize",
            "metrics": {"residual_mm": 1.0, "area_mm2": 2.0},
            "warnings": ["a hole of 3.1 mm was left"],
        }
    ]
    html = build_report(**{**arguments, "record": record})
    page = text_of(re.sub(r"<(script|style).*?</\1>", "", html, flags=re.DOTALL))
    assert not re.findall(r".{20}\bmm(?:[²³]|\b).{9}", page)
    assert "a hole of 3.1 file units was left" in page
    assert "residual [file units]" in page
    assert "area [file units²]" in page
    assert '"unit":"file units"' in html or '"unit": "file units"' in html


def test_columns_of_numbers_groups_and_names() -> None:
    columns = {"side": ["L", "R", "L", "R", "L", ""], "age": list("123456"), "name": list("abcdef"), "same": ["x"] * 6}
    assert [scores.column_kind(column) for column in columns.values()] == ["group", "number", "", ""]
    assert [(g.column, g.value, g.members) for g in groups_of(columns)] == [
        ("side", "L", (0, 2, 4)),
        ("side", "R", (1, 3)),
    ]


def test_a_plot_per_column_that_can_be_drawn(run: SmallRun) -> None:
    section = scores.render(ReportData(**run.arguments()))
    assert section is not None
    assert re.findall(r"Coloured by (\w+)", section.html) == ["side", "age", "site"]
    assert cohort_columns(run.model.ids, run.record["shapes"])["side"] == ["L", "R"] * 3


def test_landmarks_are_carried_to_where_they_were_marked(run: SmallRun) -> None:
    c = run.correspondence
    found = landmark_places(c.points, c.faces, c.topology, [run.landmarks[i] for i in c.ids])
    assert [mark["name"] for mark in found] == ["epicondyle", "notch"]
    for mark in found:
        assert len(mark["places"]) == len(c.ids)
        for k, cell, weights in mark["places"]:
            place: Floats = np.array(weights) @ c.points[k][cell]
            assert np.linalg.norm(place - run.landmarks[c.ids[k]][mark["name"]]) < 1.6  # they lie up to 3 x 0.5 mm off
    far = [{name: p + 100 for name, p in run.landmarks[i].items()} for i in c.ids]
    assert landmark_places(c.points, c.faces, c.topology, far) == []


def test_the_viewer_offers_shapes_groups_and_landmarks(run: SmallRun) -> None:
    section = render_viewer(ReportData(**run.arguments()))
    assert section is not None
    assert section.html.count('<option value="g0">side = L (mean of 3)</option>') == 2
    assert section.html.count('<option value="3">P04_right</option>') == 2
    assert "notch (6)" in section.html
