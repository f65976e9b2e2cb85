from __future__ import annotations

import logging

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.primitives import flat_square, tube
from ssmpipe.stages import cut, fit, parameterize, sample
from tests.support.meshes import bent_tube

ACROSS = {"seam_direction": (0.0, 1.0, 0.0)}


def go(stage, options=None, **inputs):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    return stage.run(**inputs, cfg=stage.Config(**(options or {})), ctx=ctx), ctx


def test_a_tube_goes_through_to_a_spline_that_closes_smoothly():
    opened, ctx = go(cut, ACROSS, mesh=bent_tube())
    assert not ctx.warnings
    assert ctx.metrics["seam_from"] == "direction"
    assert ctx.metrics["rim_1_mm"] > ctx.metrics["rim_2_mm"]
    mapped, ctx = go(parameterize, **opened)
    assert not ctx.warnings
    assert (ctx.metrics["topology"], ctx.metrics["n_flips"]) == ("tube", 0)
    assert ctx.metrics["stretch"] < ctx.metrics["stretch_before"]
    samples, _ = go(sample, {"grid": (80, 80)}, **mapped)
    fitted, ctx = go(fit, {"n_control": (30, 30)}, mesh=mapped["mesh"], **samples)
    control = fitted["surface"].control_points
    assert np.array_equal(control[0], control[-1])
    first, last = control[1] - control[0], control[-1] - control[-2]
    np.testing.assert_allclose(first, last, atol=1e-9)  # C1 over the seam
    assert ctx.metrics["topology"] == "tube"
    assert ctx.metrics["spline_to_mesh_rms_mm"] < 0.05


def test_the_straight_seam_is_the_line_u_0():
    opened, _ = go(cut, ACROSS, mesh=bent_tube())
    straight, _ = go(parameterize, {"seam": "straight"}, **opened)
    left, right = straight["seam"].pairs.T
    assert (straight["uv"][left, 0] == 0).all()
    assert (straight["uv"][right, 0] == 1).all()
    samples, _ = go(sample, {"grid": (80, 80)}, **straight)
    kept, _ = go(fit, {"n_control": (30, 30), "seam": "kept"}, mesh=straight["mesh"], **samples)
    smooth, _ = go(fit, {"n_control": (30, 30)}, mesh=straight["mesh"], **samples)
    jumps = [c[1] - 2 * c[0] + c[-2] for c in (kept["surface"].control_points, smooth["surface"].control_points)]
    assert np.abs(jumps[1]).max() < 1e-9 < 1e-3 < np.abs(jumps[0]).max()


def test_landmarks_order_the_rims_and_place_the_seam():
    pipe = bent_tube()
    points = {
        "low": pipe.vertices[0],
        "side": pipe.vertices[np.argmin(np.linalg.norm(pipe.vertices - [8, -3.5, 12], axis=1))],
    }
    opened, ctx = go(cut, mesh=pipe, landmarks=Landmarks(points, {"opening_2": "low", "seam": "side"}))
    assert ctx.metrics["seam_from"] == "landmark"
    assert ctx.metrics["rim_1_mm"] < ctx.metrics["rim_2_mm"]
    assert (opened["mesh"].vertices[opened["seam"].pairs[:, 0]] == points["side"]).all(axis=1).any()


def test_arbitrary_choices_are_told():
    _, ctx = go(cut, {"seam_direction": (1.0, 0.0, 0.0)}, mesh=tube())
    assert "the two rims are equally long" in ctx.warnings[0]
    _, ctx = go(cut, {"seam_direction": (1.0, 0.0, 0.0), "axis": (1.0, 0.0, 0.1)}, mesh=tube())
    assert "the two rims lie across cut.axis" in ctx.warnings[0]
    _, ctx = go(cut, {"seam_direction": (0.2, 0.0, 1.0), "axis": (0.0, 0.0, 1.0)}, mesh=tube())
    assert "runs nearly along the tube" in ctx.warnings[0]
    with pytest.raises(ValidationError, match="must not be zero"):
        cut.Config(axis=(0.0, 0.0, 0.0))


def test_the_path_of_the_cut_may_cross_faces():
    lengths = {}
    for path in ("edges", "geodesic"):
        opened, ctx = go(cut, {**ACROSS, "path": path}, mesh=bent_tube())
        lengths[path] = ctx.metrics["seam_mm"]
        assert opened["mesh"].n_vertices == ctx.metrics["n_vertices"]
    assert lengths["geodesic"] < 0.995 * lengths["edges"]


def test_a_tube_has_to_be_cut_first_and_a_disk_needs_no_cut():
    with pytest.raises(TopologyError, match="must be cut open"):
        go(parameterize, {"topology": "tube"}, mesh=tube())
    _, ctx = go(parameterize, mesh=flat_square(7))
    assert ctx.metrics["topology"] == "disk"
