from __future__ import annotations

import logging

import numpy as np
import pytest

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.errors import LandmarkError, TopologyError
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.topology import boundary_loops, compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import fill_holes
from tests.support.femora import DATA, read
from tests.support.meshes import relabeled

AORTAS = sorted((DATA / "aorta_synth" / "scans").glob("*"))


def go(mesh, landmarks=None, **options):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    outputs = fill_holes.run(mesh, landmarks, cfg=fill_holes.Config(**options), ctx=ctx)
    assert set(outputs) == {port.slot for port in fill_holes.STAGE.outputs}
    return outputs["mesh"], ctx


def holed_tube() -> TriMesh:
    pipe = tube(8.0, 30.0, 80, 49)
    far = np.linalg.norm(pipe.vertices - pipe.vertices[20 * 80 + 7], axis=1) > 3.0
    return compact(pipe, far[pipe.faces].all(axis=1))


def test_the_longest_loops_stay_open():
    filled, ctx = go(holed_tube(), keep_openings=2)
    assert len(boundary_loops(filled.faces)) == 2
    assert ctx.metrics["n_filled"] == 1
    assert ctx.metrics["n_stumps_removed"] == 0
    assert ctx.metrics["euler_characteristic"] == 0
    assert ctx.metrics["methods"] == ["implicit"]
    assert len(ctx.metrics["places_mm"][0]) == 3
    again, second = go(filled, keep_openings=2)
    assert np.array_equal(again.vertices, filled.vertices)
    assert np.array_equal(again.faces, filled.faces)
    assert second.metrics["n_filled"] == 0


def test_a_short_loop_is_a_hole_though_an_end_is_closed():
    mesh = holed_tube()
    loops = boundary_loops(mesh.faces)
    ends = sorted(loops, key=lambda loop: float(np.ptp(mesh.vertices[loop][:, 2])))[:2]
    middle = mesh.vertices[ends[0]].mean(axis=0)
    lid = np.c_[np.roll(ends[0], -1), ends[0], np.full(len(ends[0]), mesh.n_vertices)]
    closed = TriMesh(np.vstack([mesh.vertices, middle]), np.vstack([mesh.faces, lid]))
    kept, _ = go(closed, keep_openings=2)
    assert len(boundary_loops(kept.faces)) == 2
    filled, ctx = go(closed, keep_openings=2, opening_share=0.5)
    assert len(boundary_loops(filled.faces)) == ctx.metrics["n_openings_kept"] == 1


def test_landmarks_name_the_openings():
    mesh = holed_tube()
    ends = sorted(boundary_loops(mesh.faces), key=lambda loop: float(np.ptp(mesh.vertices[loop][:, 2])))[:2]
    marks = {f"opening_{k}": mesh.vertices[loop].mean(axis=0) for k, loop in enumerate(ends, start=1)}
    filled, ctx = go(mesh, Landmarks(marks))
    assert ctx.metrics["n_openings_kept"] == 2
    assert len(boundary_loops(filled.faces)) == 2
    same = dict.fromkeys(marks, marks["opening_1"])
    with pytest.raises(LandmarkError, match=r"opening_1 and opening_2 lie at the same loop"):
        go(mesh, Landmarks(same))
    with pytest.raises(TopologyError, match=r"3 boundary loops, 4 shall stay open \(fill-holes\.keep_openings\)"):
        go(mesh, keep_openings=4)


def test_a_landmark_in_the_middle_of_an_end_means_no_hole_beside_it():
    pipe = holed_tube()
    mark = np.array([0.0, 0.0, 25.0])
    near, *rims = sorted(
        boundary_loops(pipe.faces), key=lambda loop: float(np.linalg.norm(pipe.vertices[loop] - mark, axis=1).min())
    )
    assert len(near) < len(rims[0])
    filled, ctx = go(pipe, Landmarks({"opening_1": np.zeros(3), "opening_2": mark}))
    ends = sorted(float(filled.vertices[loop][:, 2].mean()) for loop in boundary_loops(filled.faces))
    assert ends == pytest.approx([0.0, 30.0])
    assert not ctx.warnings
    _, ctx = go(pipe, Landmarks({"opening_2": np.array([0.0, 0.0, 50.0])}), keep_openings=2)
    assert "no opening lies within its own diameter of the landmark with role opening_2" in ctx.warnings[0]


@pytest.mark.skipif(not AORTAS, reason="the aortas of ../shared/data/aorta_synth are not there")
def test_branches_of_the_arch_are_removed():
    mesh, _ = relabeled(read(AORTAS[0]), np.random.default_rng(0))
    filled, ctx = go(mesh, keep_openings=2, stump_reach_mm=40.0)
    assert ctx.metrics["n_stumps_removed"] == 3
    assert ctx.metrics["euler_characteristic"] == 0
    assert len(boundary_loops(filled.faces)) == 2
    assert ctx.warnings
    assert "its patch is a guess; look at it" in ctx.warnings[0]
