from __future__ import annotations

import logging
import re

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks, ShapeInfo
from ssmpipe.core.errors import LandmarkError, TopologyError
from ssmpipe.core.mesh.primitives import sphere, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.runner.record import methods_sentence
from ssmpipe.stages import orient, trim
from tests.support.femora import femur, landmark, needs_femora
from tests.support.meshes import aortic_root


def go(mesh: TriMesh, points: dict[str, list[float]] | None = None, **options):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    marks = Landmarks({k: np.array(v) for k, v in points.items()}) if points else None
    return trim.run(mesh, marks, cfg=trim.Config(**options), ctx=ctx)["mesh"], ctx


def heights(mesh: TriMesh) -> list[float]:
    return sorted(float(mesh.vertices[loop][:, 2].mean()) for loop in boundary_loops(mesh.faces))


class TestTube:
    def test_both_ends_are_cut_and_reported(self):
        pipe = tube(5.0, 40.0)
        mesh, ctx = go(pipe, ends=2, end_margin_mm=2.0)
        assert euler_characteristic(mesh.faces) == 0
        assert heights(mesh) == pytest.approx([2.0, 38.0], abs=1e-6)
        assert ctx.metrics["removed_1_mm"] == pytest.approx(2.0)
        assert ctx.metrics["rim_2_mm"] == pytest.approx(10 * np.pi, rel=2e-3)
        assert not ctx.warnings
        mesh, _ = go(pipe, ends=2, ends_at="fractions", end_fractions=(0.25, 0.5))
        low, high = heights(mesh)
        assert {round(low, 0), round(high, 0)} in ({10.0, 20.0}, {20.0, 30.0})

    def test_landmarks_say_where_and_a_short_scan_is_continued_with_a_warning(self):
        pipe = tube(5.0, 40.0, n_along=81)
        marks = {"opening_1": [0.0, 0.0, -3.0], "opening_2": [0.0, 0.0, 30.0]}
        mesh, ctx = go(pipe, marks, ends=2, ends_at="landmarks", extend_mm=5.0)
        assert heights(mesh) == pytest.approx([-3.0, 30.0], abs=1e-6)
        assert "ended 3.0 mm before the plane of opening 1 and was continued" in ctx.warnings[0]
        assert ctx.metrics["added_1_mm"] == pytest.approx(3.0)
        assert np.hypot(*mesh.vertices[mesh.vertices[:, 2] < 0].T[:2]) == pytest.approx(
            5.0, abs=0.011
        )  # chords of a polygon with 48 sides
        with pytest.raises(LandmarkError, match="needs both of the roles opening_1 and opening_2"):
            go(pipe, {"opening_1": [0.0, 0.0, 1.0]}, ends=2, ends_at="landmarks")

    def test_fractions_must_rise(self):
        with pytest.raises(ValidationError, match="end_fractions must rise"):
            trim.Config(ends=2, end_fractions=(0.5, 0.5))


class TestSinuses:
    def test_both_cuts_count_from_the_sinuses(self):
        mesh, ctx = go(aortic_root(), ends=2, ends_at="sinuses", below_sinuses=0.5, tube_mm=45.0)
        assert heights(mesh) == pytest.approx([-2.0, 43.0], abs=0.8)
        assert np.diff(heights(mesh))[0] == pytest.approx(45.0, abs=0.3)
        assert not ctx.warnings
        mesh, _ = go(aortic_root(), ends=2, ends_at="sinuses", below_sinuses=0.0)
        assert heights(mesh) == pytest.approx([5.0, 59.5], abs=0.6)

    def test_the_valleys_between_them_are_proposed_in_scan_coordinates(self):
        ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
        shifted = np.eye(4)
        shifted[:3, 3] = [100.0, 0.0, 0.0]
        trim.run(aortic_root(), None, shifted, cfg=trim.Config(ends=2, ends_at="sinuses"), ctx=ctx)
        proposed = ctx.metrics["landmark_candidates"]
        places = np.array([[float(x) for x in place.split()] for place in proposed.values()])
        assert list(proposed) == ["sinus_valley_1", "sinus_valley_2", "sinus_valley_3"]
        assert np.hypot(places[:, 0] + 100.0, places[:, 1]) == pytest.approx(15.2, abs=0.5)

    def test_a_landmark_says_where_the_other_end_is(self):
        options = {"ends": 2, "ends_at": "sinuses", "below_sinuses": 0.5, "tube_mm": 45.0}
        mesh, ctx = go(aortic_root(), {"trim": [0.0, 0.0, 51.0]}, **options)
        assert heights(mesh) == pytest.approx([-2.0, 51.0], abs=0.8)
        assert heights(mesh)[1] == pytest.approx(51.0, abs=0.2)
        assert not ctx.warnings
        mesh, ctx = go(aortic_root(end=40.0), {"trim": [0.0, 0.0, 51.0]}, **options)
        assert heights(mesh)[1] == pytest.approx(39.5, abs=0.1)
        assert "before the landmark of role trim, more than trim.extend_mm" in ctx.warnings[0]

    @pytest.mark.parametrize(
        ("place", "words"),
        [
            ([300.0, 0.0, 40.0], r"lies 300\.0 mm from the centre line of the tube"),
            ([0.0, 0.0, 14.0], "below the upper end of the sinuses"),
            ([0.0, 0.0, np.nan], "from the centre line"),
        ],
    )
    def test_a_landmark_at_an_impossible_place_is_refused(self, place, words):
        with pytest.raises(LandmarkError, match=f"role trim.*{words}"):
            go(aortic_root(), {"trim": place}, ends=2, ends_at="sinuses")

    def test_a_scan_that_ends_too_early_is_continued_or_cut_at_its_rim_and_says_so(self):
        options = {"ends": 2, "ends_at": "sinuses", "below_sinuses": 0.5, "tube_mm": 45.0}
        mesh, ctx = go(aortic_root(end=40.0), **options, extend_mm=6.0)
        assert heights(mesh)[1] == pytest.approx(43.0, abs=0.8)
        assert "was continued by the curvature" in ctx.warnings[0]
        mesh, ctx = go(aortic_root(end=40.0), **options, extend_mm=1.0)
        assert heights(mesh)[1] == pytest.approx(39.5, abs=0.1)
        assert "before trim.tube_mm: 45, more than trim.extend_mm" in ctx.warnings[0]

    def test_a_tube_without_sinuses_is_cut_at_its_rims_and_says_so(self):
        mesh, ctx = go(tube(10.0, 60.0), ends=2, ends_at="sinuses")
        assert heights(mesh) == pytest.approx([0.5, 59.5], abs=1e-6)
        assert "no sinuses were found" in ctx.warnings[0]
        assert ctx.metrics["sinuses"] == "not found"
        _, ctx = go(tube(10.0, 60.0), {"trim": [0.0, 0.0, 40.0]}, ends=2, ends_at="sinuses")
        assert "the landmark of role trim is left aside" in ctx.warnings[0]
        with pytest.raises(ValidationError, match="tube_mm counts from the sinuses"):
            trim.Config(ends=2, tube_mm=30.0)


class TestOneEnd:
    def test_fraction_of_the_axis_and_a_continued_scan(self):
        cap, ctx = go(sphere(20.0, 4), axis_fraction=0.4)
        assert cap.vertices[:, 2].max() == pytest.approx(-4.0, abs=0.05)
        assert ctx.metrics["cut_by"] == "axis"
        longer, ctx = go(cap, plane_point=(0.0, 0.0, -2.0), extend_mm=3.0)
        assert longer.vertices[:, 2].max() == pytest.approx(-2.0)
        assert ctx.metrics["added_mm"] == pytest.approx(2.0, abs=0.05)
        assert "continued by the curvature of its rim" in ctx.warnings[0]
        with pytest.raises(TopologyError, match="scan ends"):
            go(cap, plane_point=(0.0, 0.0, -2.0))
        with pytest.raises(ValidationError, match="not two of them"):
            trim.Config(axis_fraction=0.5, distance_mm=2.0)

    @needs_femora
    def test_below_the_lesser_trochanter_with_and_without_its_landmark(self):
        shape_id = "z035_Femur_R"
        bone, mark = femur(shape_id), landmark(shape_id, "LT")
        ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
        placed = orient.run(
            bone,
            np.eye(4),
            ShapeInfo(shape_id, "R"),
            Landmarks({"LT": mark}, {"trim": "LT"}),
            cfg=orient.Config(frame="femur-proximal"),
            ctx=ctx,
        )
        assert ctx.metrics["width_mm"] == pytest.approx(43.4, abs=1.0)
        options = {"up": (0.0, 0.0, -1.0), "offset_mm": 20.0, "find": "trochanter"}
        lowest = []
        for marks in ({"trim": placed["landmarks"].points["LT"].tolist()}, None):
            mesh, ctx = go(placed["mesh"], marks, **options)
            assert ctx.metrics["cut_by"] == ("landmark" if marks else "trochanter")
            assert euler_characteristic(mesh.faces) == 1
            lowest.append(float(mesh.vertices[:, 2].min()))
        assert lowest[0] == pytest.approx(placed["landmarks"].points["LT"][2] - 20.0)
        assert lowest[1] == pytest.approx(lowest[0], abs=3.0)
        mesh, ctx = go(placed["mesh"], **(options | {"offset_mm": 0.0, "offset_shafts": 1.0}))
        assert float(mesh.vertices[:, 2].min()) == pytest.approx(lowest[1] + 20.0 - ctx.metrics["shaft_diameter_mm"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fraction": 1.2}, "1.2 widths above the lowest point, or at the landmark with role trim where"),
        (
            {"find": "trochanter", "offset_shafts": 0.7},
            "lesser trochanter, which geometry found, shifted by 0.7 shaft diameters",
        ),
        ({"axis_fraction": 0.3, "extend_mm": 2.0}, "at 0.3 of their extent.*continued by up to 2 mm"),
        ({"distance_mm": 40.0}, "40 mm above the lowest point.$"),
        ({"plane_point": [0.0, 0.0, 1.0]}, "through a given point.$"),
        ({"ends": 2}, "across at both ends, 0.5 mm inside their rims"),
        ({"ends": 2, "ends_at": "fractions"}, "at 0.05 and 0.95 of their centre line"),
        ({"ends": 2, "ends_at": "landmarks"}, "through the landmarks of their openings"),
        (
            {"ends": 2, "ends_at": "sinuses", "tube_mm": 45.0},
            "sinuses below these, which geometry found, and 45 mm farther along",
        ),
    ],
)
def test_the_methods_paragraph_says_how_the_cut_was_found(options, words):
    assert re.search(words, methods_sentence(trim.STAGE, options))
