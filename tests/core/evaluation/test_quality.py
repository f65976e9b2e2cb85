from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.evaluation.quality import Geometry, distances, even_points, facing, signed_distances
from ssmpipe.core.outline.outline import edge_indices
from tests.support.small_run import grid_faces


def ball(radius: float, n: int = 60, top: float = np.pi) -> Geometry:
    theta, phi = np.meshgrid(np.linspace(0.01, top - 0.01, n), np.linspace(0, 2 * np.pi, n), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return Geometry(radius * points.reshape(-1, 3), grid_faces(n, n)[:, ::-1])


def test_concentric_balls_are_their_difference_apart_both_ways() -> None:
    small, large = ball(10.0), ball(12.0)
    for a, b in ((small, large), (large, small)):
        found = distances(a, b)
        for value in (found.mean, found.median, found.p99, found.maximum):
            assert value == pytest.approx(2.0, abs=0.04)  # the facets of a sphere of 60 x 60
    assert signed_distances(small.points, large) == pytest.approx(-2.0, abs=0.04)
    assert signed_distances(large.points, small) == pytest.approx(2.0, abs=0.04)


def test_one_direction_alone_hides_a_gap() -> None:
    whole, half = ball(10.0), ball(10.0, top=np.pi / 2)
    assert distances(half, whole).p99 < 0.05
    missing = distances(whole, half)
    # the far pole of a ball of radius 10 is 10 sqrt(2) from the rim of the half
    assert missing.maximum == pytest.approx(10 * np.sqrt(2), rel=0.02)
    assert missing.median < 0.2 < missing.mean


def test_dense_vertices_do_not_weigh_more() -> None:
    side = np.concatenate([np.linspace(0, 0.1, 200), np.linspace(0.12, 1, 20)])
    x, y = np.meshgrid(side, np.linspace(0, 1, 3), indexing="ij")
    plane = Geometry(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), grid_faces(len(side), 3))
    tilted = Geometry(np.array([[0, -1, 0], [0, 2, 0], [2, 2, 2.0], [2, -1, 2.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    # distance from (x, y, 0) to the plane z = x is x / sqrt(2): mean over the area 1 / (2 sqrt(2))
    assert distances(plane, tilted).mean == pytest.approx(0.5 / np.sqrt(2), rel=0.01)


def test_curves_by_length() -> None:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    edges = edge_indices(400, True)
    assert distances(Geometry(ring, edges), Geometry(1.5 * ring, edges)).mean == pytest.approx(0.5, abs=1e-3)
    assert np.abs(np.linalg.norm(even_points(Geometry(ring, edges), 1000), axis=1) - 1).max() < 1e-3


def test_what_lies_beyond_the_rim_can_be_left_out() -> None:
    """A long tube against one of a larger radius that is shorter: within its length they are one unit apart."""
    turn, up = np.meshgrid(np.linspace(0, 2 * np.pi, 49)[:-1], np.linspace(0, 10, 41), indexing="ij")

    def tube(radius: float, height: float) -> Geometry:
        points = np.stack([radius * np.cos(turn), radius * np.sin(turn), up * height / 10], axis=-1).reshape(-1, 3)
        faces = grid_faces(49, 41)
        return Geometry(points, faces % len(points))

    long, short = tube(5.0, 20.0), tube(6.0, 12.0)
    assert (facing(long.points, short) == (long.points[:, 2] < 12)).mean() > 0.96
    assert facing(short.points + [0, 0, 1e-6], long).mean() > 0.96
    assert distances(long, short).maximum == pytest.approx(np.hypot(8, 1), rel=1e-3)
    assert distances(long, short, beyond=False).maximum == pytest.approx(1, abs=0.1)
    assert distances(short, short, beyond=False).maximum == pytest.approx(0, abs=1e-9)
    assert facing(long.points, ball(30.0)).mean() > 0.96
