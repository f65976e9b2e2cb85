from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.poles import apex_of, ends_of, exit_time, insert_point, longest_axis_mode, nearest_place
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import noisy, random_motion, relabeled

X = np.array([1.0, 0, 0])


def cap() -> TriMesh:
    return trim(star_shape(4), np.array([0, 0, -10.0]), np.array([0, 0, -1.0]))


def ellipsoid(subdivisions: int = 4) -> TriMesh:
    ball = sphere(10.0, subdivisions)
    return TriMesh(ball.vertices * [2.0, 1.2, 1.0], ball.faces)


def test_exit_time_of_a_tube_is_a_parabola():
    strip = tube(height=6.0, n_along=61)
    rims = np.concatenate(boundary_loops(strip.faces))
    z = strip.vertices[:, 2]
    assert exit_time(strip, rims) == pytest.approx(z * (6.0 - z) / 2, abs=1e-9)


def test_the_apex_of_a_half_ball_is_its_top():
    half = trim(sphere(10.0, 4), np.zeros(3), np.array([0, 0, -1.0]))
    assert apex_of(half) == pytest.approx([0, 0, 10.0], abs=0.15)


def test_the_ends_of_an_ellipsoid_are_those_of_its_longest_axis():
    antapex, apex, factor, cosine = ends_of(ellipsoid(), X)
    assert apex == pytest.approx([20.0, 0, 0], abs=0.2)
    assert antapex == pytest.approx([-20.0, 0, 0], abs=0.2)
    assert cosine > 0.999
    assert factor > 1.3
    turned = ends_of(ellipsoid(), -X)
    assert turned[0] == pytest.approx(apex)
    assert turned[1] == pytest.approx(antapex)
    assert longest_axis_mode(sphere(10.0, 3))[1] == pytest.approx(1.0, abs=1e-3)


def test_poles_move_with_the_surface():
    rng = np.random.default_rng(0)
    motion = random_motion(rng)
    for matrix in (motion, reflection(0)):
        moved, _ = relabeled(move(cap(), matrix), rng)
        assert apex_of(moved) == pytest.approx(apply(matrix, apex_of(cap())[None])[0], abs=1e-6)
        lump, _ = relabeled(move(star_shape(3), matrix), rng)
        ends = ends_of(star_shape(3), X)[:2]
        other = ends_of(lump, matrix[:3, :3] @ X)[:2]
        assert np.array(other) == pytest.approx(apply(matrix, np.array(ends)), abs=1e-6)


def test_poles_hardly_move_with_noise_and_meshing():
    rng = np.random.default_rng(1)
    fine, finer = cap(), trim(star_shape(5), np.array([0, 0, -10.0]), np.array([0, 0, -1.0]))
    spread = [apex_of(noisy(fine, rng, 0.2)) - apex_of(fine) for _ in range(4)]
    # 70 mm high, edges of 2 mm
    assert np.linalg.norm(spread, axis=1).mean() < 0.8
    assert np.linalg.norm(apex_of(finer) - apex_of(fine)) < 1.0


def test_a_point_becomes_a_vertex_and_the_surface_stays():
    ball = sphere(10.0, 3)
    rng = np.random.default_rng(2)
    for point in rng.normal(size=(8, 3)):
        with_point, vertex = insert_point(ball, point)
        place = with_point.vertices[vertex]
        # edges of 1.5 mm; places near an edge are moved onto it
        assert np.linalg.norm(place - nearest_place(ball, point)) < 0.2
        assert area(with_point) == pytest.approx(area(ball))
        assert euler_characteristic(with_point.faces) == 2
        # right angles at most, so that no negative weight is made
        at, corner = np.nonzero(with_point.faces == vertex)
        sides = [with_point.vertices[with_point.faces[at, (corner + k) % 3]] - place for k in (1, 2)]
        if with_point is not ball:
            assert np.einsum("ij,ij->i", *sides).min() > -0.5 * np.prod([np.linalg.norm(s, axis=1) for s in sides])
    same, vertex = insert_point(ball, 1.3 * ball.vertices[17])
    assert same is ball
    assert vertex == 17
    with pytest.raises(GeometryError, match=r"falls on the boundary"):
        insert_point(flat_square(4), np.array([0.0, 0.4, 0.0]))
