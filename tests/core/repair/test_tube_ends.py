from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import area, face_normals
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.tube_ends import (
    EndPlane,
    open_closed_end,
    openings,
    plane_across,
    planes_at_fractions,
    planes_inside_rims,
    planes_through_points,
    trim_tube,
)
from tests.support.meshes import random_motion, relabeled

BEND = 60.0
"""Radius of the centre line of the arch [mm]."""


def arch(turn: float = np.pi, radius: float = 10.0, ragged: float = 0.0) -> TriMesh:
    """Return a tube around a circular arc in the plane y = 0; both ends lie in the plane z = 0 when it is half a circle."""
    straight = tube(radius, 1.0, n_around=60, n_along=121)
    x, y, t = straight.vertices.T
    angle = turn * t
    mesh = TriMesh(np.column_stack([(BEND + x) * np.cos(angle), y, (BEND + x) * np.sin(angle)]), straight.faces)
    if ragged:
        around = np.arctan2(y, x)
        edge = ragged * (1.2 + 0.5 * np.sin(3 * around) + 0.5 * np.sin(11 * around)) / BEND
        inner = (angle > edge) & (angle < turn - edge[::-1])
        mesh = compact(mesh, inner[mesh.faces].all(axis=1))
        loops = [loop for loop in boundary_loops(mesh.faces) if len(loop) > 20]
        assert len(loops) == 2
    return mesh


def angles(points):
    return np.arctan2(points[:, 2], points[:, 0])


@pytest.mark.parametrize("ragged", [0.0, 2.0])
def test_ends_of_an_arch_become_planar_just_inside_the_rims(ragged):
    mesh = arch(ragged=ragged)
    rims = openings(mesh, [np.array([BEND, 0, 0]), None])
    planes = planes_inside_rims(mesh, rims, 0.5)
    done = trim_tube(mesh, rims, planes)
    assert is_manifold(done.mesh.faces)
    assert euler_characteristic(done.mesh.faces) == 0
    loops = boundary_loops(done.mesh.faces)
    assert len(loops) == 2
    for rim, (point, normal) in zip(rims, planes, strict=True):
        heights = [(done.mesh.vertices[loop] - point) @ normal for loop in loops]
        assert min(float(np.abs(h).max()) for h in heights) < 1e-9
        assert float(((mesh.vertices[rim] - point) @ normal).min()) == pytest.approx(0.5, abs=1e-3)
        turned = np.arctan2(point[2], point[0])
        along = np.array([-np.sin(turned), 0.0, np.cos(turned)])
        assert abs(normal @ along) > np.cos(np.radians(1.5))
    assert max(done.removed) < 1.0 + 2.0 * ragged
    assert done.added == (0.0, 0.0)


def test_fractions_and_points_cut_across_the_centre_line():
    mesh = arch()
    rims = openings(mesh, [np.array([BEND, 0, 0]), None])
    for planes in (
        planes_at_fractions(mesh, rims, (0.25, 0.75)),
        planes_through_points(
            mesh, rims, [BEND * np.array([np.cos(a), 0, np.sin(a)]) for a in (np.pi / 4, 3 * np.pi / 4)]
        ),
    ):
        done = trim_tube(mesh, rims, planes)
        assert area(done.mesh) == pytest.approx(0.5 * area(mesh), rel=0.02)
        seen = np.degrees(angles(done.mesh.vertices))
        assert seen.min() == pytest.approx(45.0, abs=1.5)
        assert seen.max() == pytest.approx(135.0, abs=1.5)


def test_marks_deep_inside_or_far_outside_say_which_end_is_which():
    pipe = tube(1.0, 40.0, n_around=48, n_along=41)
    x, y, z = pipe.vertices.T
    cone = TriMesh(np.column_stack([(2 + z / 40) * x, (2 + z / 40) * y, z]), pipe.faces)
    for low, high in ((8.0, 32.0), (-4.5, 47.0), (32.0, 8.0)):
        rims = openings(cone, [np.array([0, 0, low]), np.array([0, 0, high])])
        heights = [float(cone.vertices[rim][:, 2].mean()) for rim in rims]
        assert heights == ([0.0, 40.0] if low < high else [40.0, 0.0])
    (first, _) = openings(cone, [np.array([0, 0, -9.0]), None])
    assert cone.vertices[first][:, 2].max() == 0.0


@pytest.mark.parametrize("noise", [0.1, 0.2])
def test_a_plane_across_a_noisy_tube_is_hardly_tilted(noise):
    pipe = tube(14.0, 60.0, n_around=88, n_along=61)
    rng = np.random.default_rng(1)
    rough = TriMesh(pipe.vertices + noise * rng.normal(size=pipe.vertices.shape), pipe.faces)
    askew = np.array([np.sin(0.07), 0.0, np.cos(0.07)])
    plane = plane_across(rough, np.array([0.0, 0.0, 12.0]), askew, 28.0)
    assert not np.allclose(plane.normal, -askew)
    assert np.degrees(np.arccos(-plane.normal[2])) < 1.2


def test_planes_through_points_lie_across_a_tube_whose_rims_are_ragged_and_askew():
    pipe = tube(10.0, 60.0, n_around=60, n_along=121)
    x, y, z = pipe.vertices.T
    askew = compact(pipe, ((z > 6.0 + 0.5 * x) & (z < 52.0 + 0.4 * y))[pipe.faces].all(axis=1))
    points = [np.array([3.0, 0.0, 14.0]), np.array([0.0, 0.0, 46.0])]
    low, high = planes_through_points(askew, openings(askew, [np.zeros(3), None]), points)
    assert low.normal == pytest.approx([0, 0, -1], abs=4e-3)
    assert high.normal == pytest.approx([0, 0, 1], abs=4e-3)
    assert (low.point, high.point) == (pytest.approx(points[0]), pytest.approx(points[1]))


def test_a_plane_that_meets_both_legs_cuts_its_own_end_only():
    mesh = arch()
    rims = openings(mesh, [np.array([BEND, 0, 0]), None])
    done = trim_tube(
        mesh, rims, (EndPlane(np.array([0, 0, 20.0]), -np.eye(3)[2]), EndPlane(np.array([0, 0, 10.0]), -np.eye(3)[2]))
    )
    legs = [done.mesh.vertices[loop] for loop in boundary_loops(done.mesh.faces)]
    assert sorted(float(leg[:, 2].mean()) for leg in legs) == pytest.approx([10.0, 20.0])


def test_a_short_end_is_continued_or_refused():
    full = arch(turn=1.0)
    rims = openings(full, [np.array([BEND, 0, 0]), None])
    middle = planes_at_fractions(full, rims, (0.1, 0.9))
    short = trim_tube(full, rims, middle).mesh
    rims = openings(short, [middle[0].point, None])
    wanted = (
        EndPlane(BEND * np.array([np.cos(0.05), 0, np.sin(0.05)]), np.array([np.sin(0.05), 0, -np.cos(0.05)])),
        EndPlane(BEND * np.array([np.cos(0.8), 0, np.sin(0.8)]), np.array([-np.sin(0.8), 0, np.cos(0.8)])),
    )
    with pytest.raises(
        TopologyError, match=r"the scan ends \d\.\d mm before the plane of the first opening.*trim\.extend_mm: \d"
    ):
        trim_tube(short, rims, wanted)
    done = trim_tube(short, rims, wanted, extend_mm=5.0)
    assert 2.0 < done.added[0] < 4.0
    assert done.added[1] == 0.0
    new = done.mesh.vertices[angles(done.mesh.vertices) < 0.1]
    off = np.hypot(np.hypot(new[:, 0], new[:, 2]) - BEND, new[:, 1]) - 10.0
    assert len(new) > 100
    assert float(np.sqrt(np.mean(off**2))) < 0.02


def test_a_lid_is_taken_off():
    mesh = arch(turn=1.5)
    first, _ = openings(mesh, [np.array([BEND, 0, 0]), None])
    closed = close_openings(mesh)
    apex = mesh.n_vertices + (0 if boundary_loops(mesh.faces)[0][0] == first[0] else 1)
    cup = compact(closed, (closed.faces != apex).all(axis=1))
    assert len(boundary_loops(cup.faces)) == 1
    opened = open_closed_end(cup)
    assert euler_characteristic(opened.faces) == 0
    assert opened.n_faces == mesh.n_faces


def test_motion_order_and_mirror_change_nothing():
    mesh = arch(turn=2.0, ragged=1.0)
    rng = np.random.default_rng(3)
    marks = [np.array([BEND, 0, 0]), BEND * np.array([np.cos(2.0), 0, np.sin(2.0)])]
    reference = planes_inside_rims(mesh, openings(mesh, marks), 0.5)
    kept = trim_tube(mesh, openings(mesh, marks), reference).mesh
    for motion in (random_motion(rng), random_motion(rng) @ reflection(1)):
        other, _ = relabeled(move(mesh, motion), rng)
        moved = [apply(motion, mark[None])[0] for mark in marks]
        rims = openings(other, moved)
        planes = planes_inside_rims(other, rims, 0.5)
        assert planes[0].point == pytest.approx(apply(motion, reference[0].point[None])[0], abs=1e-6)
        assert planes[1].normal == pytest.approx(motion[:3, :3] @ reference[1].normal, abs=1e-6)
        assert area(trim_tube(other, rims, planes).mesh) == pytest.approx(area(kept), rel=1e-7)
    assert np.isfinite(face_normals(kept)).all()


def test_refusals_say_what_is_there():
    mesh = arch(turn=1.0)
    with pytest.raises(TopologyError, match="lie at the same rim"):
        openings(mesh, [np.array([BEND, 0, 0]), np.array([BEND, 0, 1.0])])
    pricked = compact(mesh, np.arange(mesh.n_faces) != 60 * 60 + 60)
    rims = openings(pricked, [None, None])
    with pytest.raises(TopologyError, match=r"trimming left 3 openings of .*fill-holes"):
        trim_tube(pricked, rims, planes_inside_rims(pricked, rims, 0.5))
