"""Pose, side and numbering of a scan change nothing: every mesh stage commutes with them, beyond what is cut in a given frame."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ssmpipe.contract import Context
from ssmpipe.core.align.rigid import apply, reflection
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.trimming import cut_by_plane
from ssmpipe.stages import decimate, fill_holes, repair, smooth, trim
from tests.support.meshes import bent_tube, implicit_surface, joined, random_motion, relabeled, with_caps


def hurt() -> TriMesh:
    """Return a lump with two needles, a crumpled place and a speck beside it."""
    lump, rng = star_shape(4), np.random.default_rng(0)
    vertices = lump.vertices.copy()
    vertices[[100, 900]] *= [[1.5], [1.4]]
    near = np.linalg.norm(vertices - vertices[2000], axis=1) < 3.0
    vertices[near] += 1.5 * rng.normal(size=(int(near.sum()), 3))
    speck = sphere(1.0, 1)
    return joined(TriMesh(vertices, lump.faces), TriMesh(speck.vertices + [90.0, 0, 0], speck.faces))


def holed() -> TriMesh:
    pipe = bent_tube(40, 51)
    far = np.linalg.norm(pipe.vertices - [10.0, 0.0, 15.6], axis=1) > 1.8
    return compact(pipe, far[pipe.faces].all(axis=1))


def cut_aslant() -> TriMesh:
    """Return a rough tube of marching cubes with slivers, bent a little, whose upper rim is 6 mm higher on one side."""
    rough = lambda p: np.sin(3.1 * p[:, 0]) * np.sin(2.7 * p[:, 1] + 1.0) * np.sin(2.9 * p[:, 2] + 0.4 * p[:, 0])  # noqa: E731
    pipe = implicit_surface(
        lambda p: np.hypot(p[:, 0] - 0.005 * p[:, 2] ** 2, p[:, 1]) - 7.0 - 0.03 * p[:, 2] + 0.1 * rough(p), 16.0, 41
    )
    pipe = TriMesh(pipe.vertices, pipe.faces[:, ::-1])
    return cut_by_plane(pipe, np.array([0.0, 0.0, 11.0]), np.array([0.4, 0.1, 1.0]), snap=0.0)


CASES = {
    "decimate": (decimate, {"n_faces": 1500}, star_shape(4)),
    "decimate and keep the boundary": (decimate, {"n_faces": 1500, "keep_boundary": True}, bent_tube(40, 51)),
    "decimate by qslim": (decimate, {"n_faces": 1500, "method": "qslim"}, star_shape(4)),
    "repair": (repair, {}, hurt()),
    "repair faces without area": (repair, {"max_openings": 2}, with_caps(bent_tube(40, 51), 100)),
    "fill-holes": (fill_holes, {"keep_openings": 2}, holed()),
    "trim both ends": (trim, {"ends": 2}, bent_tube(40, 51)),
    "trim and continue": (
        trim,
        {"ends": 2, "ends_at": "fractions", "end_fractions": (0.03, 0.9), "extend_mm": 5.0},
        cut_aslant(),
    ),
    "smooth taubin": (smooth, {}, star_shape(3)),
    "smooth bilaplacian": (smooth, {"method": "bilaplacian"}, bent_tube()),
    "smooth curvature-flow": (smooth, {"method": "curvature-flow"}, bent_tube()),
}


def go(stage, mesh: TriMesh, options, ctx: Context | None = None) -> TriMesh:
    ctx = ctx or Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    inputs = {"landmarks": None} if any(port.slot == "landmarks" for port in stage.STAGE.inputs) else {}
    return stage.run(mesh=mesh, **inputs, cfg=stage.Config(**options), ctx=ctx)["mesh"]


def changed(mesh: TriMesh, way: str) -> tuple[TriMesh, np.ndarray]:
    """Return the mesh in another pose, numbered otherwise, or mirrored, and the matrix of that."""
    rng = np.random.default_rng(3)
    if way == "order":
        return relabeled(mesh, rng)[0], np.eye(4)
    matrix = random_motion(rng) @ (reflection(1) if way == "mirror" else np.eye(4))
    faces = mesh.faces[:, ::-1] if way == "mirror" else mesh.faces
    return TriMesh(apply(matrix, mesh.vertices), faces), matrix


@pytest.mark.parametrize("way", ["motion", "order", "mirror"])
@pytest.mark.parametrize("name", list(CASES))
def test_stages_commute_with_pose_side_and_numbering(name, way):
    stage, options, mesh = CASES[name]
    expected = go(stage, mesh, options)
    other, matrix = changed(mesh, way)
    found = go(stage, other, options)
    assert (found.n_vertices, found.n_faces) == (expected.n_vertices, expected.n_faces)
    away, partner = cKDTree(found.vertices).query(apply(matrix, expected.vertices))
    assert away.max() < 1e-6
    assert len(np.unique(partner)) == found.n_vertices
    assert volume(found) == pytest.approx(volume(expected), rel=1e-9)


def test_each_stage_keeps_the_euler_characteristic_that_it_should():
    after = {name: go(stage, mesh, options) for name, (stage, options, mesh) in CASES.items()}
    assert {name: euler_characteristic(mesh.faces) for name, mesh in after.items()} == {
        "decimate": 2,
        "decimate and keep the boundary": 0,
        "decimate by qslim": 2,
        "repair": 2,
        "repair faces without area": 0,
        "fill-holes": 0,
        "trim both ends": 0,
        "trim and continue": 0,
        "smooth taubin": 2,
        "smooth bilaplacian": 0,
        "smooth curvature-flow": 0,
    }
    assert len(boundary_loops(after["fill-holes"].faces)) == 2


def test_the_case_that_is_continued_is_continued():
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    stage, options, mesh = CASES["trim and continue"]
    go(stage, mesh, options, ctx)
    assert ctx.metrics["added_1_mm"] > 1.0


@pytest.mark.parametrize("name", ["repair", "repair faces without area", "fill-holes"])
def test_twice_is_once(name):
    stage, options, mesh = CASES[name]
    once = go(stage, mesh, options)
    twice = go(stage, once, options)
    assert np.array_equal(twice.vertices, once.vertices)
    assert np.array_equal(twice.faces, once.faces)
