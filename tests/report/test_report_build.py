from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re

import numpy as np
import pytest

from ssmpipe.contract import Table
from ssmpipe.report.build import build_report
from ssmpipe.report.patient import PatientPage, build_patient
from ssmpipe.report.payload import viewer_payload
from tests.support.small_run import SmallRun, planar_run, small_run

HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'


@pytest.fixture(scope="module")
def run() -> SmallRun:
    return small_run()


@pytest.fixture(scope="module")
def html(run: SmallRun) -> str:
    return build_report(**run.arguments())


def test_all_sections_are_there(html: str) -> None:
    keys = re.findall(r'<section id="([a-z]+)"', html)
    assert keys == [
        "summary",
        "model",
        "modes",
        "measures",
        "landmarks",
        "quality",
        "scores",
        "shapes",
        "history",
        "grids",
        "methods",
        "provenance",
    ]
    for key in keys:
        assert f'href="#{key}"' in html


def test_same_input_same_bytes(run: SmallRun, html: str) -> None:
    assert build_report(**run.arguments()) == html


def test_the_users_matplotlib_settings_do_not_matter(run: SmallRun, html: str) -> None:
    import matplotlib

    with matplotlib.rc_context({"axes.facecolor": "black", "lines.linewidth": 9, "svg.hashsalt": "other"}):
        assert build_report(**run.arguments()) == html


def test_failures_come_first_with_their_remedy(html: str) -> None:
    assert html.index("P99_broken") < html.index("6 of 7")
    assert "the surface has 2 handles" in html
    assert "What to try: segment again" in html


def test_text_from_outside_is_escaped(html: str) -> None:
    run = small_run(ids=(HOSTILE, "P02", "P03", "P04"))
    record = run.record
    record["name"] = HOSTILE
    record["config"] = {HOSTILE: [HOSTILE]}
    record["versions"] = {HOSTILE: HOSTILE}
    record["machine"] = {HOSTILE: HOSTILE}
    record["failures"][HOSTILE + "2"] = {"stage": HOSTILE, "error": HOSTILE, "remedy": HOSTILE}
    record["cohort_stages"][0]["metrics"][HOSTILE] = HOSTILE
    record["cohort_stages"][0]["warnings"] = [HOSTILE]
    record["methods"].append({"stage": "x", "sentence": HOSTILE, "cites": [HOSTILE]})
    record["shapes"][HOSTILE]["stages"][0]["metrics"][HOSTILE] = HOSTILE
    run.certificate["shapes"][HOSTILE]["status"] = HOSTILE
    transfer = Table({**run.landmark_transfer.columns, "landmark": [HOSTILE] * 8}, comment=HOSTILE)
    attacked = build_report(**{**run.arguments(), "landmark_transfer": transfer})
    assert "<script>alert" not in attacked
    assert "<img src=x" not in attacked
    assert attacked.count("<script") == html.count("<script")
    assert attacked.count("&lt;/script&gt;") > 10


def test_policy_lets_only_its_own_script_and_style_run(html: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', html)
    assert policy is not None
    text = policy[1].replace("&#39;", "'").replace("&#43;", "+")
    assert text.startswith("default-src 'none';")
    assert "unsafe" not in text
    assert "http" not in text
    for pattern in (r"<script>(.*?)</script>", r"<style>(.*?)</style>"):
        found = re.findall(pattern, html, flags=re.DOTALL)
        assert len(found) == 1
        assert "sha256-" + base64.b64encode(hashlib.sha256(found[0].encode()).digest()).decode() in text


def test_nothing_is_fetched_and_no_inline_style_is_needed(html: str) -> None:
    page = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert all(source.startswith("data:image/") for source in re.findall(r'\bsrc="([^"]*)"', page))
    assert not re.findall(r"<(?:link|iframe|object|embed)\b", page)
    assert not re.findall(r"@import|url\(", page)
    assert not re.findall(r"<[^>]+\s(?:style|on[a-z]+)=", page)


def test_pictures_have_words(html: str) -> None:
    page = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    pictures = re.findall(r"<img [^>]*>", page)
    assert len(pictures) > 10
    assert all(re.search(r'alt="[^"]{8,}"', picture) for picture in pictures)


def test_an_almost_empty_record_still_gives_a_report(run: SmallRun) -> None:
    bare = {
        **run.arguments(),
        "record": {},
        "landmark_transfer": None,
        "certificate": {},
        "history": Table({}),
        "measures": Table({}),
        "quality": None,
        "landmarks": None,
    }
    keys = re.findall(r'<section id="([a-z]+)"', build_report(**bare))
    assert keys == ["summary", "model", "modes", "scores", "grids", "methods", "provenance"]


def test_a_refuted_pole_qualifies_the_certificate(run: SmallRun) -> None:
    proved = build_report(**run.arguments())
    first = sorted(run.certificate["shapes"])[0]
    shapes = {i: dict(one) for i, one in run.certificate["shapes"].items()}
    shapes[first]["poles"] = [{"v": 1, "status": "refuted"}]
    html = build_report(**{**run.arguments(), "certificate": {"shapes": shapes}})
    assert "not at a pole of 1 shape" in html
    assert "no part of a surface is used twice" in proved
    assert "no part of a surface is used twice" not in html
    assert "it may fold there" in html
    page = PatientPage(first, run.record, [], run.correspondence, run.model, {"shapes": shapes})
    assert "the surface may fold at a pole" in build_patient(page)


def test_a_refuted_certificate_is_said_in_words(run: SmallRun) -> None:
    certificate = {
        "shapes": {**run.certificate["shapes"], "P02_right": {"lower_bound": -0.1, "status": "refuted", "method": "x"}}
    }
    assert "folds over on P02_right" in build_report(**{**run.arguments(), "certificate": certificate})


def test_the_three_measures_never_stand_alone(run: SmallRun, html: str) -> None:
    assert "crowding the points" in html
    alone = build_report(**{**run.arguments(), "landmark_transfer": None})
    assert "crowding the points" in alone
    assert "none in this run" in alone


@pytest.mark.parametrize("topology", ["curve-open", "curve-closed"])
def test_outlines_in_the_plane(topology: str) -> None:
    assert "the grey diagonal means unchanged" in build_report(**planar_run(topology).arguments())


@pytest.mark.parametrize("topology", ["tube", "cone", "closed"])
def test_surfaces_that_close_around(run: SmallRun, topology: str) -> None:
    n_1, n_2 = run.model.grid
    axes = np.meshgrid(np.arange(n_1) / n_1, np.linspace(0, 1, n_2), indexing="ij")
    u = np.tile(np.stack(axes, axis=-1).reshape(-1, 2), (len(run.model.ids), 1, 1))
    correspondence = dataclasses.replace(run.correspondence, topology=topology, parameters=(u + [0.4, 0]) % [1.0, 2.0])
    model = dataclasses.replace(run.model, topology=topology)
    html = build_report(**{**run.arguments(), "model": model, "correspondence": correspondence})
    assert html.count("<span>1.00 to 1.00</span>") == len(run.model.ids)  # no jump at the seam


@pytest.mark.slow
def test_size_of_a_report_of_ordinary_size() -> None:
    ids = tuple(f"P{i:02d}" for i in range(50))
    run = small_run(ids, n=51, n_modes=10)
    html = build_report(**run.arguments())
    assert len(html.encode()) < 6e6
    assert html.count("data-mode=") == 10


def test_the_viewer_of_many_points_stays_small(run: SmallRun) -> None:
    # as many modes as shapes and ten times the usual points: the last modes are left out, and the page says so
    n_points, n_modes = 26000, 49
    rng = np.random.default_rng(0)
    large = dataclasses.replace(
        run.model,
        mean=rng.normal(size=(n_points, 3)),
        modes=rng.normal(size=(n_modes, n_points, 3)),
        variances=np.linspace(2, 1, n_modes),
        scores=rng.normal(size=(6, n_modes)),
        grid=(130, 200),
        faces=rng.integers(0, n_points, (2 * n_points, 3)),
    )
    payload = viewer_payload(large, look=(0, 0), unit="mm")
    assert len(json.dumps(payload)) < 4.2e6
    assert 10 <= len(payload["modes"]["step"]) < n_modes
