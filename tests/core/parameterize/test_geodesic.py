from __future__ import annotations

import igl
import numpy as np
import pytest

from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import area, edge_lengths
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, tube
from ssmpipe.core.mesh.topology import boundary_loops, compact, is_manifold
from ssmpipe.core.parameterize import geodesic
from ssmpipe.core.parameterize.cutting import shortest_path
from ssmpipe.core.parameterize.geodesic import inserted, straightened
from tests.support.meshes import bent_tube, noisy

NONE = np.array([], dtype=np.int64)


def length_of(mesh, path) -> float:
    return float(edge_lengths(mesh, np.column_stack([path[:-1], path[1:]])).sum())


def exact(mesh, start: int, goal: int) -> float:
    """Return the exact distance (Mitchell, Mount and Papadimitriou), by libigl."""
    found = igl.exact_geodesic(mesh.vertices, mesh.faces, np.array([start]), NONE, np.array([goal]), NONE)
    return float(np.ravel(found)[0])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["square", "ball", "star", "tube"])
def test_it_is_as_long_as_the_exact_distance(kind, seed):
    rng = np.random.default_rng(seed)
    mesh = {
        "square": flat_square(15, 14.0),
        "ball": sphere(10.0, 3),
        "star": noisy(star_shape(3), rng, 0.5),
        "tube": bent_tube(24, 31),
    }[kind]
    inner = np.setdiff1d(np.arange(mesh.n_vertices), np.concatenate(boundary_loops(mesh.faces) or [NONE]))
    start, goal = (int(k) for k in rng.choice(inner, 2, replace=False))
    path = shortest_path(mesh, start, np.array([goal]), np.setdiff1d(np.arange(mesh.n_vertices), inner))
    found = straightened(mesh, path)
    shortest = exact(mesh, start, goal)
    # around bumps there are several geodesics: the one beside the path need not be the shortest of all
    assert shortest * (1 - 1e-9) < found.length < (1.02 if kind in ("ball", "star") else 1 + 1e-9) * shortest
    assert found.length <= length_of(mesh, path) * (1 + 1e-12)
    # as edges it is the same line on the same surface
    made, along = inserted(mesh, found)
    assert (along[0], along[-1]) == (start, goal)
    assert length_of(made, along) == pytest.approx(found.length, rel=1e-3)
    assert is_manifold(made.faces)
    assert area(made) == pytest.approx(area(mesh), rel=1e-12)
    assert np.array_equal(made.vertices[: mesh.n_vertices], mesh.vertices)


def test_most_are_the_shortest_of_all_on_a_lump():
    mesh, rng, equal = star_shape(2), np.random.default_rng(5), 0
    for _ in range(12):
        start, goal = (int(k) for k in rng.choice(mesh.n_vertices, 2, replace=False))
        length = straightened(mesh, shortest_path(mesh, start, np.array([goal]), NONE)).length
        equal += length < exact(mesh, start, goal) * (1 + 1e-9)
    assert equal >= 9


def test_a_helix_on_a_tube():
    pipe = tube(5.0, 20.0, 40, 21)
    start, goal = 0 * 21 + 3, 10 * 21 + 17  # a quarter around, 14 mm along
    path = shortest_path(pipe, start, np.array([goal]), NONE)
    around = 10 * 2 * 5.0 * np.sin(np.pi / 40)
    assert straightened(pipe, path).length == pytest.approx(np.hypot(around, 14.0), rel=1e-12)


def test_a_line_pressed_against_the_boundary_is_refused():
    square = flat_square(9, 8.0)
    corner = square.vertices[square.faces].mean(axis=1)
    notched = compact(square, ~((np.abs(corner[:, 0] - 4.0) < 1.0) & (corner[:, 1] < 6.0)))
    at = {tuple(p[:2]): k for k, p in enumerate(notched.vertices)}
    rim = np.concatenate(boundary_loops(notched.faces))
    path = shortest_path(notched, at[1.0, 1.0], np.array([at[7.0, 1.0]]), rim)
    with pytest.raises(
        TopologyError, match=r"runs along the boundary at \((3|5)\.0, 6\.0, 0\.0\) mm.*cut\.path: edges"
    ):
        straightened(notched, path)


def test_bends_that_are_apart_are_straightened_in_one_round(monkeypatch):
    mesh, calls = bent_tube(48, 121), {"_around": 0, "_unfolded": 0}
    for name in calls:
        plain = getattr(geodesic, name)

        def counted(*given, name=name, plain=plain):
            calls[name] += 1
            return plain(*given)

        monkeypatch.setattr(geodesic, name, counted)
    rims = boundary_loops(mesh.faces)
    ends = np.array([rims[0][0], rims[1][20]])
    path = shortest_path(mesh, int(ends[0]), ends[1:], np.setdiff1d(np.concatenate(rims), ends))
    found = straightened(mesh, path)
    assert found.length < 0.999 * length_of(mesh, path)
    assert calls["_around"] > 2 * calls["_unfolded"] > 0, calls
