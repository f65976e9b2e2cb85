from __future__ import annotations

import logging

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import LandmarkError
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import trim


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
