from __future__ import annotations

import logging

import numpy as np
import pytest

from ssmpipe.contract import Context, ShapeInfo
from ssmpipe.core.align.features import femur_candidates, valley_candidates
from ssmpipe.core.align.rigid import apply, homogeneous, move
from ssmpipe.core.mesh.curvature import principal_curvatures
from ssmpipe.core.mesh.primitives import sphere, tube
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import orient
from ssmpipe.synth import femur_proximal as fp
from tests.support.meshes import random_motion


def clover() -> TriMesh:
    """Return a tube of radius 15 with three grooves at 60, 180 and 300 degrees, deepest half way up."""
    pipe = tube(1.0, 40.0, n_around=180, n_along=60)
    x, y, z = pipe.vertices.T
    bulge = np.exp(-(((z - 20.0) / 8.0) ** 2))
    radius = 15.0 + 3.0 * bulge * np.abs(np.cos(1.5 * np.arctan2(y, x)))
    return TriMesh(np.column_stack([radius * x, radius * y, z]), pipe.faces)


def test_curvatures_of_a_cylinder():
    pipe = tube(10.0, 40.0, n_around=120, n_along=80)
    curvatures = principal_curvatures(pipe, 2.5)
    middle = np.abs(pipe.vertices[:, 2] - 20.0) < 10.0
    assert curvatures[middle, 0] == pytest.approx(0.1, rel=0.05)
    assert curvatures[middle, 1] == pytest.approx(0.0, abs=1e-3)


def test_the_three_valleys_lie_between_the_bulges():
    motion = random_motion(np.random.default_rng(0))
    found = valley_candidates(move(clover(), motion))
    places = apply(np.linalg.inv(motion), np.array([c.point for c in found.values()]))
    angles = np.sort(np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360.0)
    assert angles == pytest.approx([60.0, 180.0, 300.0], abs=3.0)
    assert np.abs(places[:, 2] - 20.0).max() < 4.0
    assert min(c.strength for c in found.values()) > 0.0


def test_candidates_are_reported_in_scan_coordinates_and_change_nothing():
    mesh, transform = clover(), homogeneous(2.0 * np.eye(3), np.array([1.0, 2.0, 3.0]))
    outputs = {}
    for candidates in ("none", "valleys"):
        ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
        outputs[candidates] = orient.run(
            mesh,
            transform,
            ShapeInfo("a"),
            cfg=orient.Config(mirror="none", frame="none", candidates=candidates),
            ctx=ctx,
        )
    assert np.array_equal(outputs["none"]["mesh"].vertices, outputs["valleys"]["mesh"].vertices)
    shown = ctx.metrics["landmark_candidates"]
    place = np.array([float(x) for x in shown["valley_1"].split()])
    expected = (valley_candidates(mesh)["valley_1"].point - [1.0, 2.0, 3.0]) / 2.0
    assert place == pytest.approx(expected, abs=0.01)


def test_a_sphere_has_no_valley_worth_the_name():
    assert max(c.strength for c in valley_candidates(sphere(10.0, 3)).values()) < 0.0


def test_the_fovea_and_the_lesser_trochanter_of_a_femur_are_found_in_any_pose():
    vertices, faces = fp.template_mesh(2.0)
    marks = fp.template_landmarks(vertices)
    motion = random_motion(np.random.default_rng(2))
    found = femur_candidates(move(TriMesh(vertices, faces), motion))
    for name, mark in (("fovea", "FOVEA"), ("lesser_trochanter", "LT")):
        assert found[name].point == pytest.approx(apply(motion, marks[mark][None])[0], abs=3.0)
        assert found[name].strength > 0.5
