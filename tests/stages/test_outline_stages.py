"""The stages for planar outlines, one at a time and as a chain."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import ConfigError, ConvergenceError, GeometryError
from ssmpipe.core.outline.align import mirror_outline
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.spline.fit_curve import curve_points
from ssmpipe.stages import _align_outline, _fit_outline, align, contour, evaluate, fit, model, optimize


def go(module: Any, **inputs: Any) -> tuple[dict[str, Any], Context]:
    options = inputs.pop("options", {})
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    return module.run(**inputs, cfg=module.Config(**options), ctx=ctx), ctx


def egg(
    n: int = 80, long: float = 30.0, turn: float = 0.0, shift: int = 0, at: tuple[float, float] = (0, 0)
) -> Outline:
    t = 2 * np.pi * np.arange(n) / n
    points = np.column_stack([long * np.cos(t) + 4 * np.cos(2 * t) + 2 * np.sin(3 * t), 18 * np.sin(t)])
    c, s = np.cos(turn), np.sin(turn)
    return Outline(np.roll(points @ np.array([[c, s], [-s, c]]) + at, shift, axis=0), True)


@pytest.mark.parametrize("module", [contour, _align_outline, _fit_outline])
def test_options_are_described(module: Any) -> None:
    for name, field in module.Config.model_fields.items():
        assert field.description, name
        assert field.description.endswith("."), name


def test_variants_are_found_by_their_inputs() -> None:
    assert align.STAGE.suiting({"contour", "transform"}) is _align_outline.OUTLINE
    assert align.STAGE.suiting({"mesh", "transform"}) is align.STAGE
    assert align.STAGE.suiting({"samples"}) is align.STAGE
    assert fit.STAGE.suiting({"contour"}) is _fit_outline.OUTLINE
    for stage in (align.STAGE, fit.STAGE):
        assert all((v.name, v.scope) == (stage.name, stage.scope) for v in stage.variants)


class TestContour:
    def test_clockwise_outlines_are_turned_around_and_kept_otherwise(self) -> None:
        outline = egg()
        clockwise = Outline(outline.points[::-1], True)
        for options, sign in (({}, 1), ({"orient": False}, -1)):
            made, ctx = go(contour, contour=clockwise, options=options)
            assert np.sign(made["contour"].signed_area) == sign
            assert made["contour"].length == pytest.approx(outline.length)
            assert ctx.metrics["closed"] is True
            assert not ctx.warnings

    @pytest.mark.parametrize("closed", ["auto", True, False])
    def test_a_small_gap_means_closed_unless_the_option_says_otherwise(self, closed: Any) -> None:
        gap = Outline(egg().points, False)
        wide = Outline(egg().points[:60], False)
        made = [go(contour, contour=c, options={"closed": closed})[0]["contour"].closed for c in (gap, wide)]
        assert made == {"auto": [True, False], True: [True, True], False: [False, False]}[closed]
        kept = go(contour, contour=egg(), options={"closed": False})[0]["contour"]
        assert np.array_equal(kept.points[0], kept.points[-1])

    def test_the_start_is_the_landmark_else_the_farthest_point(self) -> None:
        outline = egg(shift=17)
        made = go(contour, contour=outline)[0]["contour"]
        centre = made.points.mean(axis=0)
        assert np.linalg.norm(made.points - centre, axis=1).argmax() == 0
        marks = Landmarks({"nose": np.array([0.0, 25.0])}, {"start": "nose"})
        begun = go(contour, contour=outline, landmarks=marks)[0]["contour"]
        distance = point_to_segments(marks.points["nose"][None], outline.points, outline.edges)[0]
        assert np.linalg.norm(begun.points[0] - marks.points["nose"]) == pytest.approx(distance[0])
        first = go(contour, contour=outline, options={"start": "first"})[0]["contour"]
        np.testing.assert_array_equal(first.points, outline.points)

    def test_open_outlines_run_from_start_to_end(self) -> None:
        line = Outline(np.column_stack([np.linspace(0, 9, 10), np.zeros(10)]), False)
        for marks, first in (
            ({}, 0.0),
            ({"start": np.array([8.0, 1.0])}, 9.0),
            ({"end": np.array([1.0, 1.0])}, 9.0),
            ({"start": np.array([0.0, 1.0])}, 0.0),
        ):
            made = go(contour, contour=line, landmarks=Landmarks(marks))[0]["contour"]
            assert made.points[0, 0] == first

    def test_bad_outlines_are_named(self) -> None:
        flat = Outline(np.array([[0, 0], [1, 0], [2, 0.0]]), True)
        with pytest.raises(GeometryError, match="encloses no area"):
            go(contour, contour=flat)
        points = egg().points.copy()
        points[[10, 40]] = points[[40, 10]]
        assert "crosses itself" in go(contour, contour=Outline(points, True))[1].warnings[0]


class TestAlign:
    def test_pose_and_start_are_undone_and_the_transform_leads_back(self) -> None:
        reference = egg(400)
        moved = egg(400, turn=2.0, shift=123, at=(50, -20))
        marks = Landmarks({"tip": moved.points[0]})
        made, ctx = go(align_of(moved), contour=moved, transform=np.eye(4), reference=reference, landmarks=marks)
        assert ctx.metrics["rms_mm"] < 0.1
        assert np.linalg.norm(made["contour"].points[0] - reference.points[0]) < reference.length / 200
        back = made["landmarks"].transformed(np.linalg.inv(made["transform"])).points["tip"]
        np.testing.assert_allclose(back, marks.points["tip"])

    def test_a_start_landmark_is_kept(self) -> None:
        moved = egg(400, shift=123)
        marks = Landmarks({"start": moved.points[0]})
        made, _ = go(_align_outline, contour=moved, transform=np.eye(4), reference=egg(400, shift=123), landmarks=marks)
        np.testing.assert_allclose(made["contour"].points[0], made["landmarks"].points["start"])

    def test_left_and_right_are_told_apart_and_the_transform_leads_back(self) -> None:
        reference, moved = egg(400), egg(400, turn=2.0, shift=123, at=(50, -20))
        flipped = mirror_outline(moved)
        kept, ctx = go(_align_outline, contour=flipped, transform=np.eye(4), reference=reference)
        assert "fits better mirrored" in ctx.warnings[0]
        assert np.linalg.det(kept["transform"]) == pytest.approx(1.0)
        marks = Landmarks({"tip": flipped.points[0]})
        options = {"chirality": "best-fit"}
        made, ctx = go(
            _align_outline, contour=flipped, transform=np.eye(4), reference=reference, landmarks=marks, options=options
        )
        assert ctx.metrics["mirrored"]
        assert not ctx.warnings
        assert ctx.metrics["rms_mm"] < 0.1
        assert made["contour"].signed_area > 0
        assert np.linalg.det(made["transform"]) == pytest.approx(-1.0)
        back = made["landmarks"].transformed(np.linalg.inv(made["transform"])).points["tip"]
        np.testing.assert_allclose(back, marks.points["tip"])
        made, ctx = go(_align_outline, contour=moved, transform=np.eye(4), reference=reference, options=options)
        assert not ctx.metrics["mirrored"]

    def test_the_reference_is_the_medoid_or_named(self) -> None:
        inputs = {f"s{k}": {"contour": egg(long=26.0 + 2 * k, turn=k), "landmarks": None} for k in range(5)}
        ctx = Context("", np.random.default_rng(0), logging.getLogger("test"))
        made = _align_outline.prepare(inputs, cfg=_align_outline.Config(), ctx=ctx)
        assert ctx.metrics["reference"] == "s2"
        assert made["reference"] is inputs["s2"]["contour"]
        with pytest.raises(ConfigError, match="no shape 'x'"):
            _align_outline.prepare(inputs, cfg=_align_outline.Config(reference="x"), ctx=ctx)
        with pytest.raises(GeometryError, match="is open, the reference is closed"):
            go(_align_outline, contour=Outline(egg().points, False), transform=np.eye(4), reference=egg())


def align_of(outline: Outline) -> Any:
    assert align.STAGE.suiting({"contour", "transform"}).run is _align_outline.run
    return _align_outline


class TestFit:
    @pytest.mark.parametrize("closed", [True, False])
    def test_sparse_and_uneven_points_do_no_harm(self, closed: bool) -> None:
        rng = np.random.default_rng(0)
        keep = np.sort(rng.choice(400, 60, replace=False))
        outline = Outline(egg(400).points[keep], closed)
        made, ctx = go(_fit_outline, contour=outline)
        assert ctx.metrics["spline_to_contour_max_mm"] < 0.02 * outline.diagonal
        assert not ctx.warnings
        first, last = curve_points(made["surface"], np.array([0.0, 1.0]))
        assert np.array_equal(first, last) == closed

    def test_a_coarse_fit_warns(self) -> None:
        _, ctx = go(_fit_outline, contour=egg(), options={"n_control": 5})
        assert "raise fit.n_control" in ctx.warnings[0]

    @pytest.mark.parametrize("closed", [True, False])
    def test_a_tolerance_gets_as_few_control_points_as_keep_it(self, closed: bool) -> None:
        outline = Outline(egg(400).points[: 400 if closed else 300], closed)
        counts = []
        for tolerance in (0.1, 0.02):
            made, ctx = go(_fit_outline, contour=outline, options={"tolerance_mm": tolerance})
            n = ctx.metrics["n_control"]
            assert max(ctx.metrics[f"{d}_rms_mm"] for d in ("contour_to_spline", "spline_to_contour")) <= tolerance
            same, _ = go(_fit_outline, contour=outline, options={"n_control": n})
            np.testing.assert_array_equal(made["surface"].control_points, same["surface"].control_points)
            _, fewer = go(_fit_outline, contour=outline, options={"n_control": n - 1})
            assert max(fewer.metrics[f"{d}_rms_mm"] for d in ("contour_to_spline", "spline_to_contour")) > tolerance
            counts.append(n)
        assert counts[0] < counts[1] < 60

    def test_given_points_keep_the_tolerance_at_the_points(self) -> None:
        sparse = egg(40)
        _, ctx = go(_fit_outline, contour=sparse, options={"tolerance_mm": 0.01, "points": "given"})
        assert ctx.metrics["contour_to_spline_rms_mm"] <= 0.01 < ctx.metrics["spline_to_contour_rms_mm"]

    def test_a_tolerance_out_of_reach_is_refused(self) -> None:
        zigzag = Outline(np.column_stack([np.arange(60.0), np.arange(60) % 2]), False)
        with pytest.raises(ConvergenceError, match="500 control points leave a distance of"):
            go(_fit_outline, contour=zigzag, options={"tolerance_mm": 1e-6})

    def test_given_points_are_fitted_by_their_parameters(self) -> None:
        errors = {}
        for parameters in ("chord", "uniform"):
            keep = np.unique((400 * np.linspace(0, 0.97, 120) ** 1.5).astype(int))
            outline = Outline(egg(400).points[keep], False)
            options = {"points": "given", "parameters": parameters, "n_control": 20}
            errors[parameters] = go(_fit_outline, contour=outline, options=options)[1].metrics[
                "contour_to_spline_rms_mm"
            ]
        assert 0 < errors["chord"] < 0.1
        assert errors["uniform"] != errors["chord"]


def test_a_cohort_of_closed_outlines_goes_through_the_group_stages() -> None:
    rng = np.random.default_rng(1)
    shapes, transforms, marks = {}, {}, {}
    reference = go(contour, contour=egg(200))[0]["contour"]
    for k in range(5):
        raw = egg(
            200, long=26 + 2 * k, turn=rng.uniform(0, 6), shift=int(rng.integers(200)), at=tuple(rng.normal(size=2))
        )
        tip = raw.points[np.linalg.norm(raw.points - raw.points.mean(axis=0), axis=1).argmax()]
        prepared = go(contour, contour=raw)[0]["contour"]
        made, _ = go(
            _align_outline,
            contour=prepared,
            transform=np.eye(4),
            reference=reference,
            landmarks=Landmarks({"tip": tip}),
        )
        name = f"e{k}"
        shapes[name] = go(_fit_outline, contour=made["contour"])[0]["surface"]
        transforms[name], marks[name] = made["transform"], made["landmarks"]
    options = {"n_coefficients": (8,), "landmarks": (60,)}
    found, _ = go(optimize, surface=shapes, transform=transforms, landmarks=marks, options=options)
    correspondence = found["correspondence"]
    assert correspondence.topology == "curve-closed"
    assert correspondence.points.shape == (5, 60, 2)
    assert found["certificate"]["all_proved"]
    built, _ = go(model, correspondence=correspondence, info={})
    assert isinstance(built["model_meshes"]["mean"], Outline)
    assert built["model_meshes"]["mean"].closed
    measured, ctx = go(evaluate, correspondence=correspondence, landmarks=marks, transform=transforms)
    assert measured["landmark_transfer"].columns["n_shapes"][0] == 5
    assert ctx.metrics["landmark_transfer_optimized_mm"] < 0.05 * reference.diagonal


def test_outlines_within_a_tolerance_become_one_cohort_with_the_same_correspondence() -> None:
    transform = {f"e{k}": np.eye(4) for k in range(5)}
    eggs = {f"e{k}": egg(400, long=26 + 2 * k) for k in range(5)}
    found = {}
    for name, options in (("fixed", {"n_control": 160}), ("tolerance", {"tolerance_mm": 0.005})):
        fits = {i: go(_fit_outline, contour=e, options=options) for i, e in eggs.items()}
        numbers = {ctx.metrics["n_control"] for _, ctx in fits.values()}
        assert (len(numbers) > 1) == (name == "tolerance")
        splines = {i: made["surface"] for i, (made, _) in fits.items()}
        options = {"n_coefficients": (8,), "landmarks": (101,)}
        made, _ = go(optimize, surface=splines, transform=transform, landmarks=None, options=options)
        assert made["certificate"]["all_proved"]
        found[name] = made["correspondence"]
    fixed, within = found["fixed"], found["tolerance"]
    assert within.description_length[1] == pytest.approx(fixed.description_length[1], rel=5e-3)
    assert within.description_length[1] < within.description_length[0]
    apart = np.linalg.norm(within.points - fixed.points, axis=-1)
    moved = np.linalg.norm(fixed.points - fixed.initial_points, axis=-1)
    assert np.sqrt((apart**2).mean()) < 0.1 * np.sqrt((moved**2).mean())


def test_the_closed_form_is_chosen_by_the_config_and_refuses_what_has_none() -> None:
    closed = {"n_coefficients": (8,), "landmarks": (31,), "covariance": "I", "quadrature": "closed-form"}
    curves = {}
    for k, long in enumerate((28.0, 30.0, 33.0)):
        curves[f"e{k}"] = go(_fit_outline, contour=egg(long=long, turn=0.1 * k), options={"n_control": 20})[0][
            "surface"
        ]
    transform = {i: np.eye(4) for i in curves}
    out, ctx = go(optimize, surface=curves, transform=transform, landmarks=None, options=closed)
    assert out["certificate"]["all_proved"]
    assert ctx.metrics["normals"] == 0  # curves have none by default
    assert ctx.metrics["description_length_after"] < ctx.metrics["description_length_before"]
    for change, words in (
        ({"covariance": "II"}, "set covariance: I"),
        ({"pose": "each-evaluation"}, "poses may not move"),
        ({"form": "sampled"}, "use form: bezier"),
        ({"n_coefficients": (8, 8), "landmarks": (31, 31)}, "surfaces have none"),
    ):
        with pytest.raises(ValueError, match=words):
            optimize.Config(**{**closed, **change})  # type: ignore[arg-type]
