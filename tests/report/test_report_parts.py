from __future__ import annotations

import base64
import dataclasses
import hashlib
import importlib
import pkgutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ssmpipe.stages
from ssmpipe.contract import Table
from ssmpipe.report.bibliography import REFERENCES
from ssmpipe.report.page import resource
from ssmpipe.report.payload import viewer_payload
from ssmpipe.report.section import ReportData, by_correspondence
from ssmpipe.report.sections import candidates, shapes, summary
from ssmpipe.report.sections.grids import area_factors, grid_nodes
from ssmpipe.report.sections.landmarks import _pivot
from ssmpipe.report.solid import good_view, picture, vertex_normals, view_axes
from ssmpipe.report.wording import number
from tests.support.small_run import grid_faces, small_run

VIEWER = Path(__file__).parents[2] / "viewer"


def test_the_viewer_gets_the_model_to_16_bits() -> None:
    model = small_run().model
    payload = viewer_payload(model, look=(0, 0), unit="mm")
    n = model.mean.size
    mean = np.frombuffer(base64.b64decode(payload["mean"]["data"]), "<u2").reshape(-1, 3)
    decoded = np.array(payload["mean"]["offset"]) + payload["mean"]["step"] * mean
    assert np.abs(decoded - model.mean).max() <= 0.51 * payload["mean"]["step"]
    assert payload["mean"]["step"] < np.ptp(model.mean) / 6e4
    modes = np.frombuffer(base64.b64decode(payload["modes"]["data"]), "<i2").reshape(-1, n)
    for k, step in enumerate(payload["modes"]["step"]):
        truth = (model.modes[k] * model.variances[k] ** 0.5).ravel()
        assert np.abs(modes[k] * step - truth).max() <= 0.51 * step
    assert (np.frombuffer(base64.b64decode(payload["faces"]), "<u2").reshape(-1, 3) == model.faces).all()


def test_area_factors_of_a_known_map() -> None:
    u = np.linspace(0, 1, 31)
    nodes = np.stack(np.meshgrid(u**2, u, indexing="ij"), axis=-1)
    factors = area_factors(nodes)
    middle = (u[1:] + u[:-1]) / 2
    np.testing.assert_allclose(factors, np.tile(2 * middle[:, None], (1, 30)), atol=1e-12)
    assert factors.mean() == pytest.approx(1)
    assert (area_factors(nodes[::-1]) < 0).all()


def test_a_periodic_grid_is_closed_without_a_jump() -> None:
    u = (np.linspace(0, 1, 20, endpoint=False) + 0.35) % 1.0
    grid = np.stack(np.meshgrid(u, np.linspace(0, 1, 5), indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = grid_nodes(grid, (20, 5), "tube")
    assert nodes.shape == (21, 5, 2)
    np.testing.assert_allclose(area_factors(nodes), 1.0, atol=1e-12)


def test_normals_of_a_sphere_point_outwards() -> None:
    theta, phi = np.meshgrid(np.linspace(0.3, 2.8, 40), np.linspace(0, 2 * np.pi, 60), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    normals = vertex_normals(points, grid_faces(40, 60)[:, ::-1])
    assert (normals * points).sum(axis=1).min() > 0.99


@pytest.mark.parametrize("view", [(-90.0, 0.0), (30.0, 45.0), (200.0, -80.0)])
def test_view_axes_are_a_right_handed_frame(view: tuple[float, float]) -> None:
    axes = view_axes(*view)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_a_picture_shows_the_surface_and_leaves_the_corner_white() -> None:
    model = small_run().model
    shot = picture(
        model.mean, model.faces, view=good_view(model.mean, model.faces), centre=model.mean.mean(axis=0), radius=90.0
    )
    assert (shot[0, 0] == 255).all()
    middle = shot[shot.shape[0] // 2, shot.shape[1] // 2]
    assert middle.max() < 255


def test_the_nearer_surface_hides_the_farther() -> None:
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]])
    points = np.concatenate([square, square + [0, -1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    colours = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 4, axis=0)
    for order in (slice(None), slice(None, None, -1)):
        shot = picture(points, faces[order], view=(-90, 0), centre=np.zeros(3), radius=1.2, colours=colours)
        red, _, blue = shot[shot.shape[0] // 2, shot.shape[1] // 2].astype(int)
        assert blue > 100 > red


def test_tables_are_split_in_reading_order() -> None:
    table = Table({"correspondence": ["optimized", "initial"], "n_modes": [1, 1], "generalization": ["1.5", None]})
    first, second = by_correspondence(table)
    assert (first.name, second.name) == ("initial", "optimized")
    assert np.isnan(first.columns["generalization"][0])
    assert second.columns["generalization"] == [1.5]


def test_baselines_join_the_landmark_table() -> None:
    table = Table(
        {
            "landmark": ["all", "notch", "all", "notch", "all"],
            "correspondence": ["optimized", "optimized", "affine-icp", "affine-icp", "initial"],
            "n_pairs": [132, 132, 132, 132, 132],
            "mean_mm": [2.6, 2.3, 2.63, 2.4, 3.4],
        }
    )
    pivot = _pivot(table)
    assert pivot is not None
    assert pivot["groups"] == ["before optimization", "after optimization", "affine icp"]
    assert [row["name"] for row in pivot["rows"]] == ["notch", "all"]
    assert pivot["rows"][0]["values"] == [None, 2.3, 2.4]
    assert pivot["rows"][1]["values"] == [3.4, 2.6, 2.63]
    assert pivot["common"] == ["n_pairs"]


def data(**changes: Any) -> ReportData:
    return ReportData(**{**small_run().arguments(), **changes})


def test_the_table_of_shapes_names_only_stages_that_change_the_mesh() -> None:
    run = data()
    columns = shapes._size_columns(run, shapes._stage_order(run))
    assert list(columns) == ["scan", "repair", "trim", "decimate"]
    raw = run.record["shapes"]["P01_left"]["stages"][0]["metrics"]
    assert columns["scan"]["P01_left"] == (raw["n_vertices_in"], raw["n_faces_in"])
    assert "P99_broken" not in columns["repair"]


def test_of_two_directions_of_the_fit_the_larger_is_shown() -> None:
    stage = {"metrics": {"mesh_to_spline_rms_mm": 0.05, "spline_to_mesh_rms_mm": 0.07, "mesh_to_spline_max_mm": 0.4}}
    assert shapes._largest(stage, "rms") == 0.07
    assert shapes._largest(stage, "max") == 0.4
    assert shapes._largest({}, "max") is None


def test_the_summary_says_the_numbers_of_the_tables() -> None:
    run = data()
    few = summary.modes_for(run, 0.9)
    n_modes = len(run.model.variances)
    text = summary.render(run).html
    assert f"{number(run.measures.columns['generalization'][n_modes + few - 1])} mm per point" in text
    assert "2.58 mm from the marked ones on average; before optimization it was 3.40 mm" in text
    assert "6 of 7" in text


def test_the_summary_says_that_sides_are_not_checked() -> None:
    run = data()

    def said(sides: str, **options: Any) -> str:
        align = {"check_mirror": False, "chirality": "keep", **options}
        config = {**run.record["config"], "stages": [{"align": align}]}
        given = zip(run.shapes.items(), sides.ljust(len(run.shapes)), strict=True)
        named = {i: {**shape, "info": {"side": side.strip()}} for (i, shape), side in given}
        return summary.render(data(record={**run.record, "config": config, "shapes": named})).html

    assert "Left and right are not checked" in said("")
    assert "Left and right are mixed" in said("LRRRRRR")
    for silent in (said("RRRRRRR"), said("", check_mirror=True), said("", chirality="best-fit")):
        assert "Left and right are" not in silent


def test_modes_needed_for_a_share_of_the_variance() -> None:
    model = dataclasses.replace(small_run().model, variances=np.array([8.0, 1.0, 0.5, 0.5]))
    assert [summary.modes_for(data(model=model), share) for share in (0.5, 0.8, 0.9, 0.95, 1.0)] == [1, 1, 2, 3, 4]


STAGES = sorted(m.name for m in pkgutil.iter_modules(ssmpipe.stages.__path__) if not m.name.startswith("_"))


@pytest.mark.parametrize("name", STAGES)
def test_every_key_that_a_stage_cites_is_in_the_bibliography(name: str) -> None:
    stage = importlib.import_module(f"ssmpipe.stages.{name}").STAGE
    for each in (stage, *stage.variants):
        assert set(each.cites) <= set(REFERENCES)


def test_the_bundle_carries_the_licence_and_cannot_end_its_element() -> None:
    bundle = resource("assets", "viewer.js")
    assert "Permission is hereby granted, free of charge" in bundle
    assert "three.js authors" in bundle
    assert "</script" not in bundle.lower()
    assert "<!--" not in bundle


@pytest.mark.skipif(not VIEWER.exists(), reason="the viewer's sources are not here (installed from a wheel)")
def test_the_bundle_was_built_from_these_sources() -> None:
    names = ["build.mjs", "package-lock.json", *sorted(f"src/{path.name}" for path in (VIEWER / "src").iterdir())]
    text = "".join((VIEWER / name).read_text(encoding="utf-8") for name in names)
    assert hashlib.sha256(text.encode()).hexdigest() in resource("assets", "viewer.js")[:200], (
        "run: npm run build in viewer/"
    )


def test_places_that_geometry_proposes_have_a_table_of_their_own() -> None:
    assert candidates.render(data()) is None
    record = small_run().record
    record["shapes"]["P02_right"]["stages"] = [
        {
            "stage": "orient",
            "status": "done",
            "metrics": {"landmark_candidates": {"fovea": "1.00 2.00 3.00"}, "width_mm": 4.0},
        },
        {
            "stage": "trim",
            "status": "done",
            "metrics": {"landmark_candidates": {"lesser_trochanter": "4.00 5.00 6.00"}},
        },
    ]
    section = candidates.render(data(record=record))
    assert section is not None
    assert "fovea" in section.html
    assert "lesser trochanter" in section.html
    assert section.html.count("<tr>") == 2
    assert "1.00 2.00 3.00</td><td>4.00 5.00 6.00" in section.html
    table = shapes.render(data(record=record))
    assert "landmark candidates" not in table.html
    assert "1.00 2.00" not in table.html
