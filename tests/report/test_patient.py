from __future__ import annotations

import base64
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ssmpipe.core.evaluation.landmark_transfer import locate
from ssmpipe.core.evaluation.quality import Geometry
from ssmpipe.report.patient import PatientPage, StepShape, _distances, _motion, build_patient, corresponded_state
from ssmpipe.report.raster import rasterize, thinned
from tests.support.small_run import grid_faces, small_run

RUN = small_run()
HOSTILE = '</script><script>window.attacked = 1</script><img src=x onerror="alert(2)">'


def sphere(radius: float, n: int = 24) -> Geometry:
    theta, phi = np.meshgrid(np.linspace(1e-3, np.pi - 1e-3, n), np.linspace(0, 2 * np.pi, n), indexing="ij")
    points = radius * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return Geometry(points.reshape(-1, 3), grid_faces(n, n)[:, ::-1])


def turned() -> np.ndarray:
    return np.array([[0, -1.0, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def example(name: str = "P02_right", **changes) -> PatientPage:
    k = RUN.model.ids.index(name)
    body = sphere(20)
    steps = [
        StepShape("scan", body, np.eye(4)),
        StepShape("01-repair", body, np.eye(4)),
        StepShape("04-smooth", sphere(18), np.eye(4)),
        StepShape("06-align", sphere(18).moved(turned()), turned()),
        corresponded_state(RUN.correspondence, k),
    ]
    rebuilt = {
        "ids": np.array(RUN.model.ids),
        "points": RUN.correspondence.points + 0.5,
        "distance": np.full(RUN.correspondence.points.shape[:2], 0.5),
    }
    page = PatientPage(
        id=name,
        record=RUN.record,
        steps=steps,
        correspondence=RUN.correspondence,
        model=RUN.model,
        certificate=RUN.certificate,
        quality=RUN.quality,
        reconstructions=rebuilt,
        landmarks=RUN.landmarks[name],
        before="P01_left",
        after="P03_left",
    )
    return replace(page, **changes)


@pytest.fixture(scope="module")
def html() -> str:
    return build_patient(example())


def test_the_page_has_its_parts_and_its_neighbours(html: str) -> None:
    assert re.findall(r'<section id="([a-z]+)"', html) == ["summary", "shape", "stages", "numbers", "origin"]
    for link in ("../report.html", "P01_left.html", "P03_left.html"):
        assert f'href="{link}"' in html
    assert "P02_right.stl" in html
    assert "proved" in html


def test_same_input_same_bytes_and_pictures_have_words(html: str) -> None:
    assert build_patient(example()) == html
    pictures = re.findall(r"<img [^>]*>", html)
    assert len(pictures) >= 7
    assert all(re.search(r'alt="[^"]{5,}"', picture) for picture in pictures)
    page = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert all(source.startswith("data:image/") for source in re.findall(r'\bsrc="([^"]*)"', page))
    assert not re.findall(r"<[^>]+\s(?:style|on[a-z]+)=", page)


def test_only_what_a_stage_changed_is_coloured(html: str) -> None:
    stages = dict(re.findall(r'<h3 id="step-\d+">\d+\. ([^<]+)</h3>(.*?)</article>', html, flags=re.DOTALL))
    assert "Dark red" not in stages["repair"]
    assert "Dark red: 2 mm or more." in stages["smooth"]  # a ball of radius 20 became one of 18
    assert "turned by 90.0°, shifted by 5.00 mm" in stages["align"]
    assert "Dark red" not in stages["align"]
    assert "corresponded surface" in stages


def test_a_failed_shape_has_reason_and_remedy_and_no_model() -> None:
    html = build_patient(example("P02_right", id="P99_broken", steps=[StepShape("scan", sphere(20), np.eye(4))]))
    assert re.findall(r'<section id="([a-z]+)"', html) == ["summary", "stages", "origin"]
    assert "set aside at the stage repair" in html
    assert html.count("the surface has 2 handles") == 2  # on top, and where it stopped
    assert html.count("What to try: segment again") == 2
    nothing = build_patient(PatientPage("P99_broken", RUN.record, []))
    assert "What to try: segment again" in nothing


def test_places_that_geometry_proposes_are_shown_on_the_scan(html: str) -> None:
    record = small_run().record
    record["shapes"]["P02_right"]["stages"][0]["metrics"] = {"landmark_candidates": {"fovea": "2 0 0"}}  # in cm
    steps = [StepShape("scan", sphere(20), np.diag([10.0, 10.0, 10.0, 1.0])), *example().steps[1:]]
    page = build_patient(example(record=record, steps=steps))
    assert "Landmarks that geometry proposes" not in html
    (section,) = re.findall(r'<section id="candidates".*?</section>', page, flags=re.DOTALL)
    assert "2 0 0" in section
    (source,) = re.findall(
        r'src="data:image/png;base64,([^"]*)" width="200" height="200" alt="fovea on the scan"', section
    )
    drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(source))).convert("RGB")).astype(int)
    red = (drawn[..., 0] > drawn[..., 1] + 60) & (drawn[..., 0] > 60)
    middle = np.argwhere(red).mean(axis=0) / drawn.shape[:2]
    assert 0.0005 < red.mean() < 0.01
    assert middle == pytest.approx([0.5, 0.5], abs=0.03)  # seen from where it lies


def test_text_from_outside_is_escaped(html: str) -> None:
    record = small_run().record
    shape = record["shapes"]["P02_right"]
    shape["file"] = HOSTILE
    shape["info"] = {HOSTILE: HOSTILE}
    shape["stages"][0] |= {"metrics": {HOSTILE: HOSTILE}, "warnings": [HOSTILE]}
    record["failures"]["P02_right"] = {"stage": HOSTILE, "error": HOSTILE, "remedy": HOSTILE}
    record["name"] = HOSTILE
    attacked = build_patient(example(record=record, before=HOSTILE))
    assert "<script>window" not in attacked
    assert "<img src=x" not in attacked
    assert attacked.count("<script") == html.count("<script")


def test_motions_in_words() -> None:
    mirror = np.diag([-1.0, 1, 1, 1])
    assert _motion(mirror, sphere(1), "mm") == "Moved: mirrored to the other side."
    assert _motion(np.diag([1e3, 1e3, 1e3, 1]), sphere(1), "mm") == "Moved: scaled by 1000."
    assert _motion(np.eye(4), sphere(1), "mm") == ""


def test_a_ball_is_drawn_round_and_lit_from_above() -> None:
    ball = sphere(1.0, 60)
    shot = rasterize(0.8 * ball.points, ball.points, ball.cells, np.full((len(ball.points), 3), 0.9), 200)
    covered = (shot < 255).any(axis=2)
    assert covered.mean() == pytest.approx(np.pi * 0.8**2 / 4, rel=0.01)
    assert shot[60, 100].mean() > shot[140, 100].mean()
    inside = np.hypot(*(np.indices((200, 200)) - 99.5)) < 77
    assert covered[inside].all()  # no hole anywhere


def test_large_and_small_triangles_give_the_same_picture() -> None:
    square = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0.0]])
    up, grey = np.tile([0, 0, 1.0], (4, 1)), np.full((4, 3), 0.5)
    large = rasterize(square, up, np.array([[0, 1, 2], [0, 2, 3]]), grey, 64)
    x, y = np.meshgrid(np.linspace(-3, 3, 300), np.linspace(-3, 3, 300), indexing="ij")
    fine = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    small = rasterize(
        fine, np.tile([0, 0, 1.0], (90000, 1)), grid_faces(300, 300)[:, ::-1], np.full((90000, 3), 0.5), 64
    )
    assert (large == large[0, 0]).all()
    np.testing.assert_array_equal(large, small)


def test_thinning_keeps_original_points_and_the_outline() -> None:
    ball = sphere(10.0, 150)
    kept, faces = thinned(ball.points, ball.cells, 0.8)
    assert len(kept) < len(ball.points) / 5
    assert faces.max() == len(kept) - 1
    assert np.ptp(ball.points[kept], axis=0) == pytest.approx(20.0, abs=0.5)


def test_distances_are_exact_and_points_that_stayed_are_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    ball, searched = sphere(10.0), []

    def counted(places: np.ndarray, points: np.ndarray, cells: np.ndarray):
        searched.append(len(places))
        return locate(places, points, cells)

    monkeypatch.setattr("ssmpipe.report.patient.locate", counted)
    places = ball.points.copy()
    places[100:110] *= 1.1
    found = _distances(places, ball, 1e-5)
    exact = locate(places, ball.points, ball.cells)[0]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-5)
    assert found[100:110].min() > 0.9
    assert searched == [10]


def test_a_picture_is_that_of_the_nearest_triangle_of_every_pixel() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.2, 1.2, (240, 3))
    normals, faces, grey = np.tile([0, 0, 1.0], (240, 1)), np.arange(240).reshape(80, 3), rng.uniform(0.2, 1, (240, 3))
    shot = rasterize(points, normals, faces, grey, 40)
    rows, columns = np.indices((40, 40))
    at = np.stack([(columns + 0.5) / 20 - 1, 1 - (rows + 0.5) / 20], axis=-1)
    depth, owner = np.full((40, 40), -np.inf), np.full((40, 40), -1)
    for k, (a, b, c) in enumerate(points[faces]):  # every triangle against every pixel
        w = np.linalg.solve(np.stack([b - a, c - a], axis=1)[:2], (at - a[:2]).reshape(-1, 2).T).reshape(2, 40, 40)
        z = a[2] + w[0] * (b[2] - a[2]) + w[1] * (c[2] - a[2])
        over = (w.min(axis=0) >= 0) & (w.sum(axis=0) <= 1) & (z > depth)
        depth[over], owner[over] = z[over], k
    assert (owner < 0).any()
    assert ((shot < 255).any(axis=2) == (owner >= 0)).mean() > 0.99
    alone = [rasterize(points, normals, faces[k : k + 1], grey, 40) for k in range(80)]
    expected = np.array(
        [[alone[owner[i, j]][i, j] if owner[i, j] >= 0 else [255] * 3 for j in range(40)] for i in range(40)]
    )
    assert (shot == expected).all(axis=2).mean() > 0.99
