from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import flat_square, sphere, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.core.parameterize.cutting import cut_along, shortest_path

NONE = np.zeros(0, dtype=np.int64)


def test_a_tube_becomes_a_disk():
    opened = cut_along(tube(n_around=6, n_along=4), np.arange(4))
    assert euler_characteristic(opened.mesh.faces) == 1
    assert len(boundary_loops(opened.mesh.faces)) == 1
    assert opened.pairs.shape == (4, 2)
    left, right = opened.pairs.T
    assert np.array_equal(opened.mesh.vertices[left], opened.mesh.vertices[right])
    assert np.array_equal(opened.origin[right], left)
    # vertices 4..7 follow counter-clockwise, seen from outside they lie to the right of the way up: the left copies bound them
    neighbours = opened.mesh.faces[np.isin(opened.mesh.faces, left).any(axis=1)]
    assert set(np.unique(neighbours)) == {0, 1, 2, 3, 4, 5, 6, 7}


@pytest.mark.parametrize("seed", range(3))
def test_a_ball_opens_between_two_poles(seed):
    ball = sphere(5.0, 3)
    start, end = np.random.default_rng(seed).choice(ball.n_vertices, 2, replace=False)
    path = shortest_path(ball, int(start), np.array([end]), NONE)
    assert path[0] == start
    assert path[-1] == end
    opened = cut_along(ball, path, (int(start), int(end)))
    assert euler_characteristic(opened.mesh.faces) == 1
    assert is_manifold(opened.mesh.faces)
    assert area(opened.mesh) == pytest.approx(area(ball))
    assert len(opened.pairs) == len(path) - 2


def test_the_shortest_path_is_short_and_keeps_out():
    square = flat_square(5)
    assert shortest_path(square, 0, np.array([24]), NONE).tolist() == [0, 6, 12, 18, 24]
    around = shortest_path(square, 0, np.array([24]), np.array([12]))
    assert 12 not in around
    # it touches its targets in the end only
    rim = np.array([4, 9, 14, 19, 24])
    assert np.isin(shortest_path(square, 10, rim, NONE), rim).sum() == 1
    with pytest.raises(TopologyError, match=r"no path of edges"):
        shortest_path(square, 0, np.array([24]), np.arange(10, 15))
