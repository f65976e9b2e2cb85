from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from ssmpipe.core.evaluation.quality import Geometry
from ssmpipe.report.projected import ProjectedPage, build_projected
from ssmpipe.report.projected_index import ProjectedIndex, build_index
from tests.support.small_run import planar_run, small_run

RUN = small_run()
HOSTILE = '</script><script>window.attacked = 1</script><img src=x onerror="alert(2)">'


def numbers(n_modes: int) -> dict:
    told = {
        f"{d}_{w}_mm": 0.5 + k for d in ("to_scan", "from_scan") for k, w in enumerate(("mean", "median", "p95", "max"))
    }
    return {
        "scores": np.linspace(-1.5, 2.5, n_modes), "deviations": np.full(n_modes, 0.2), "mahalanobis": 3.25, "mahalanobis_p": 0.4,
        "residual_rms_mm": 0.8, "residual_p": 0.3, "certificate": {"status": "proved", "lower_bound": 0.6}, **told,
    }  # fmt: skip


def whole(**changes) -> ProjectedPage:
    points = RUN.correspondence.points[1]
    page = ProjectedPage(
        id="new_07", file="new_07.stl", side="L", unit="mm", version="0.1.0", model_name="model.npz", numbers=numbers(5), model=RUN.model,
        points=points, reconstruction=points + 0.5, mahalanobis=np.array([1.5, 2.0, 2.5, 3.0, 3.5, 4.0]), residuals=np.full(6, 0.7),
        matrix=np.diag([-1.0, 1, 1, 1]), map_name="Distance of the scan from its reconstruction", map_values=np.full(len(points), -0.5),
        scan=Geometry(points, RUN.model.faces), scan_distance=np.linspace(-1, 1, len(points)), warnings=[("repair", "2 pieces dropped")],
    )  # fmt: skip
    return replace(page, **changes)


def part(**changes) -> ProjectedPage:
    told = {
        **numbers(5),
        "seen_share": 0.63,
        "expected_error_mm": 1.5,
        "holes_left": 1,
        "certificate": {"status": "partial"},
    }
    del told["residual_rms_mm"], told["residual_p"]
    return whole(numbers=told, reconstruction=None, map_values=np.full(len(RUN.model.mean), 0.9), **changes)


@pytest.fixture(scope="module")
def html() -> str:
    return build_projected(whole())


def test_it_has_its_parts_and_says_how_usual_the_shape_is(html: str) -> None:
    assert re.findall(r'<section id="([a-z]+)"', html) == [
        "summary",
        "shape",
        "scan",
        "coefficients",
        "distances",
        "origin",
    ]
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))
    assert "This shape lies at 3.25: a share of 0.40 lies as far out" in text
    assert (
        "half lie within 2.09 standard deviations of the mean and 95 % within 3.33" in text
    )  # of chi with 5 degrees of freedom
    assert "repair : 2 pieces dropped" in text
    assert re.search(r'<th scope="row">1</th><td>−1.50</td><td>0.200</td>', html)
    assert "mirrored to the other side" in text


def test_it_works_offline_and_is_the_same_again(html: str) -> None:
    assert build_projected(whole()) == html
    assert "default-src &#39;none&#39;" in html
    page = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert all(source.startswith("data:image/") for source in re.findall(r'\bsrc="([^"]*)"', page))
    assert not re.findall(r"<[^>]+\s(?:style|on[a-z]+)=", page)
    assert all(re.search(r'alt="[^"]{5,}"', picture) for picture in re.findall(r"<img [^>]*>", page))


def test_a_completed_fragment_shows_what_was_seen_and_no_certificate() -> None:
    html = build_projected(part())
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))
    for words in ("63 %", "1.50 mm", "holes left open", "completed surface"):
        assert words in text
    assert "one-to-one" not in text
    payload = json.loads(re.search(r'id="model-data">(.*?)</script>', html)[1])
    assert len(payload["shapes"]) == 1
    assert payload["maps"][0]["signed"] is False


def test_what_the_model_does_not_cover_is_told(html: str) -> None:
    page = build_projected(whole(numbers={**numbers(5), "beyond_share": 0.35}))
    assert "35 % of it lies beyond the part that the model covers" in page
    assert "beyond the part that the model covers" not in html


def test_outlines_and_file_units() -> None:
    run = planar_run("curve-closed")
    page = whole(
        model=run.model, points=run.model.mean, reconstruction=run.model.mean, scan=None, scan_distance=None, unit="file units",
        map_values=np.zeros(len(run.model.mean)), numbers=numbers(2),
    )  # fmt: skip
    html = build_projected(page)
    assert "The outline" in html
    assert "0.800 file units" in html


def test_text_from_outside_is_escaped(html: str) -> None:
    attacked = build_projected(
        whole(id=HOSTILE, file=HOSTILE, model_name=HOSTILE, side=HOSTILE, warnings=[(HOSTILE, HOSTILE)])
    )
    assert "<script>window" not in attacked
    assert "<img src=x" not in attacked
    assert attacked.count("<script") == html.count("<script")


def index(**changes) -> ProjectedIndex:
    near, far = numbers(5), {**numbers(5), "mahalanobis": 9.5, "mahalanobis_p": 1 / 7, "side": "L"}
    made = ProjectedIndex(
        name="patients", unit="mm", version="0.1.0", model_name="model.npz", numbers={"near": near, "far": far},
        files={"near": "near.stl", "far": "far.stl", "bad": "bad.stl"}, pages={"far": "far.html"},
        mahalanobis=np.array([1.5, 2.0, 2.5, 3.0, 3.5, 4.0]), residuals=np.full(6, 0.7), warnings={"far": [("repair", "2 pieces dropped")]},
        failures={"bad": {"stage": "repair", "error": "no faces", "remedy": "export it again"}},
    )  # fmt: skip
    return replace(made, **changes)


def test_the_list_names_the_most_unusual_first_and_what_failed() -> None:
    html = build_index(index())
    assert re.findall(r'<section id="([a-z]+)"', html) == ["summary", "patients"]
    rows = [row.split("<td") for row in re.findall(r"<tr><th scope=\"row\">(.*?)</tr>", html, flags=re.DOTALL)]
    assert [re.sub("<[^>]+>", "", row[0]) for row in rows] == ["far", "near"]
    assert ('href="far.html"' in rows[0][0], "href" in rows[1][0]) == (True, False)
    assert ("badge bad" in rows[0][3], "badge bad" in rows[1][3]) == (True, False)
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))
    for words in (
        "2 of 3",
        "bad (bad.stl) stopped at repair : no faces",
        "export it again",
        "far , repair: 2 pieces dropped",
    ):
        assert words in text
    assert "training shapes 2.75, at most 4.00" in text
    assert "default-src &#39;none&#39;" in html
    assert not re.findall(r"<[^>]+\s(?:style|on[a-z]+)=", html)


def test_the_list_of_fragments_and_of_nothing() -> None:
    html = build_index(index(numbers={"piece": part().numbers}, unit="file units"))
    assert "seen [%]" in html
    assert re.search(r"<td>63</td><td>1.50</td><td>0.500</td><td>2.50</td><td>1</td>", html)
    assert "expected error [file units]" in html
    assert "One-to-one" not in html
    assert '<section id="patients"' not in build_index(index(numbers={}))


def test_text_in_the_list_is_escaped() -> None:
    numbers_ = {HOSTILE: {**numbers(5), "side": HOSTILE}}
    failures = {HOSTILE + "x": {"stage": HOSTILE, "error": HOSTILE, "remedy": HOSTILE}}
    attacked = build_index(
        index(name=HOSTILE, model_name=HOSTILE, numbers=numbers_, files={HOSTILE + "x": HOSTILE}, failures=failures,
              warnings={HOSTILE: [(HOSTILE, HOSTILE)]}, pages={HOSTILE: HOSTILE + ".html"})
    )  # fmt: skip
    assert "<script>window" not in attacked
    assert "<img src=x" not in attacked
    assert attacked.count("<script") == build_index(index()).count("<script")
