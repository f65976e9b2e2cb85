from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.mesh.operators import area, volume
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import (
    boundary_loops,
    compact,
    euler_characteristic,
    face_components,
    genus,
    handle_loop,
    is_manifold,
    loop_length,
    split_edges,
    unique_edges,
)
from tests.support.meshes import joined, relabeled


@pytest.mark.parametrize(
    ("mesh", "chi", "handles", "loops"),
    [(sphere(), 2, 0, 0), (torus(), 0, 1, 0), (tube(), 0, 0, 2), (flat_square(), 1, 0, 1), (star_shape(), 2, 0, 0)],
    ids=["sphere", "torus", "tube", "square", "star"],
)
def test_invariants_of_known_surfaces_survive_relabeling(mesh, chi, handles, loops):
    shuffled, _ = relabeled(mesh, np.random.default_rng(0))
    for m in (mesh, shuffled):
        assert (euler_characteristic(m.faces), genus(m.faces), len(boundary_loops(m.faces))) == (chi, handles, loops)
        assert is_manifold(m.faces)


def test_primitives_point_outward_and_have_the_right_size():
    assert volume(sphere(2.0, 5)) == pytest.approx(4 / 3 * np.pi * 8, rel=2e-3)
    assert area(sphere(2.0, 5)) == pytest.approx(4 * np.pi * 4, rel=1e-3)
    assert volume(torus(3.0, 1.0, 200, 100)) == pytest.approx(2 * np.pi**2 * 3, rel=2e-3)
    assert volume(star_shape()) > 0


def test_boundary_runs_with_the_surface_on_its_left():
    square = flat_square(5)
    loop = boundary_loops(square.faces)[0]
    x, y, _ = square.vertices[loop].T
    assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) == pytest.approx(1.0)
    assert loop_length(square, loop) == pytest.approx(4.0)


def test_handle_loop_of_a_torus_is_its_meridian():
    ring = torus(3.0, 1.0, 60, 30)
    shuffled = relabeled(ring, np.random.default_rng(1))[0]
    loop = handle_loop(shuffled)
    assert loop_length(shuffled, loop) == pytest.approx(2 * np.pi, rel=0.02)
    assert np.hypot(*shuffled.vertices[loop].mean(axis=0)[:2]) == pytest.approx(3.0, abs=0.05)
    elsewhere = handle_loop(shuffled, avoid=loop)
    assert not np.isin(loop, elsewhere).any()
    assert handle_loop(sphere()) is None


def test_components_do_not_join_in_a_vertex():
    assert set(face_components(compact(joined(flat_square(3), flat_square(3))).faces)) == {0, 1}
    two = np.array([[0, 1, 2], [2, 3, 4]])
    assert list(face_components(two)) == [0, 1]


@pytest.mark.parametrize("n", [1, 7, 40, 208])
def test_splitting_edges_keeps_area_and_topology(n):
    square = flat_square(9)
    edges = unique_edges(square.faces).vertices
    chosen = edges[np.random.default_rng(n).permutation(len(edges))[:n]]
    split = split_edges(square, chosen[:, ::-1], square.vertices[chosen].mean(axis=1))
    assert area(split) == pytest.approx(1.0)
    assert euler_characteristic(split.faces) == 1
    assert is_manifold(split.faces)
    assert split.n_vertices == square.n_vertices + len(chosen)
    assert volume(split) == pytest.approx(0.0)
    e, f = (split.vertices[split.faces[:, k]] - split.vertices[split.faces[:, 0]] for k in (1, 2))
    assert (np.cross(e, f)[:, 2] > 0).all()
