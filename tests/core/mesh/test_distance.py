from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.mesh.distance import (
    barycentric_coordinates,
    interpolate,
    point_to_mesh,
    sample_surface,
    surface_deviation,
)
from ssmpipe.core.mesh.operators import surface_centroid, surface_covariance
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape
from ssmpipe.core.mesh.sections import section_areas
from tests.support.meshes import random_motion, relabeled


def test_distance_to_a_plane_is_the_height_and_places_are_found():
    square = flat_square(6)
    points = np.random.default_rng(0).uniform(0, 1, (200, 3))
    distance, face, weights = point_to_mesh(points, square)
    assert distance == pytest.approx(points[:, 2])
    assert interpolate(square.vertices, square, face, weights)[:, :2] == pytest.approx(points[:, :2])


def test_distance_is_equivariant_and_agrees_with_brute_force():
    lump = star_shape(2)
    rng = np.random.default_rng(1)
    points = 60 * rng.normal(size=(50, 3))
    distance, face, weights = point_to_mesh(points, lump)
    motion = random_motion(rng)
    moved = point_to_mesh(points @ motion[:3, :3].T + motion[:3, 3], move(lump, motion))[0]
    assert moved == pytest.approx(distance, rel=1e-9)
    t = np.linspace(0, 1, 15)
    grid = np.array([[1 - a - b, a, b] for a in t for b in t if a + b <= 1 + 1e-12])
    dense = np.einsum("gk,fkd->fgd", grid, lump.vertices[lump.faces]).reshape(-1, 3)
    brute = np.sqrt(((points[:, None] - dense[None]) ** 2).sum(axis=2).min(axis=1))
    assert (distance <= brute + 1e-9).all()
    assert np.abs(distance - brute).max() < 2.0
    assert np.linalg.norm(points - interpolate(lump.vertices, lump, face, weights), axis=1) == pytest.approx(distance)


def test_concentric_spheres_are_their_radii_apart():
    deviation = surface_deviation(sphere(10.0, 5), sphere(12.0, 5))
    assert deviation.rms == pytest.approx(2.0, rel=5e-3)
    assert deviation.maximum == pytest.approx(2.0, rel=5e-3)
    assert deviation == surface_deviation(sphere(10.0, 5), sphere(12.0, 5))


def test_samples_are_uniform_in_area():
    lump = star_shape(3)
    points, _, weights = sample_surface(lump, 40000)
    assert weights.min() >= 0
    assert points.mean(axis=0) == pytest.approx(surface_centroid(lump), abs=0.3)
    assert np.cov(points.T) == pytest.approx(surface_covariance(lump), rel=0.03, abs=5)


@pytest.mark.parametrize("mirrored", [False, True])
def test_samples_go_along_with_the_surface(mirrored: bool):
    lump, rng = star_shape(3), np.random.default_rng(2)
    motion = random_motion(rng) @ (reflection(0) if mirrored else np.eye(4))
    other = relabeled(move(lump, motion), rng)[0]
    points, face, weights = sample_surface(other, 3000)
    assert np.abs(points - apply(motion, sample_surface(lump, 3000)[0])).max() < 1e-10
    assert interpolate(other.vertices, other, face, weights) == pytest.approx(points)


def test_degenerate_triangles_do_not_break_barycentrics():
    needle = np.array([[[0, 0, 0], [1, 0, 0], [0.5, 0, 0.0]]])
    assert barycentric_coordinates(np.array([[0.25, 0, 0]]), needle) == pytest.approx(np.array([[0.75, 0.25, 0]]))


def test_sections_of_a_sphere():
    areas, middles = section_areas(sphere(10.0, 5), np.array([0, 0, 1.0]), np.array([-6.0, 0.01, 8.0, 12.0]))
    assert areas == pytest.approx(np.pi * np.array([64.0, 100.0, 36.0, 0.0]), rel=5e-3)
    assert middles[0] == pytest.approx([0, 0, -6], abs=1e-2)
    assert np.isnan(middles[3]).all()
