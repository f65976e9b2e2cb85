from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.primitives import sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.intersections import crossings, intersecting_pairs, repair_intersections
from tests.support.meshes import joined


def crumpled(mesh: TriMesh, reach: float, *middles: int) -> TriMesh:
    """Move vertices near some places by about an edge at random."""
    rng = np.random.default_rng(0)
    away = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[list(middles)][None], axis=2).min(axis=1)
    size = np.linalg.norm(mesh.vertices[mesh.faces[0, 0]] - mesh.vertices[mesh.faces[0, 1]])
    moved = (away < reach)[:, None] * rng.normal(size=mesh.vertices.shape)
    return TriMesh(mesh.vertices + size * moved, mesh.faces)


@pytest.mark.parametrize("mesh", [sphere(), star_shape(3), torus(), tube()], ids=["ball", "star", "torus", "tube"])
def test_sound_surfaces_do_not_intersect(mesh):
    assert len(intersecting_pairs(mesh)) == 0
    assert crossings(mesh, intersecting_pairs(mesh)) == []
    assert repair_intersections(mesh) is mesh


def test_two_balls_intersect_in_one_ring():
    ball = sphere(10.0, 3)
    both = joined(ball, TriMesh(ball.vertices + [15.0, 0.1, 0.2], ball.faces))
    pairs = intersecting_pairs(both)
    middle = both.vertices[both.faces[pairs]].mean(axis=(1, 2))
    # the circle in which the balls meet
    assert np.abs(middle[:, 0] - 7.5).max() < 1.0
    assert np.abs(np.hypot(middle[:, 1], middle[:, 2]) - np.sqrt(100 - 56.25)).max() < 1.0
    (crossing,) = crossings(both, pairs)
    assert crossing.place == pytest.approx((7.5, 0.05, 0.1), abs=0.3)
    assert crossing.n_faces == len(np.unique(pairs))


def test_folds_are_found_and_replaced():
    lump = star_shape(4)
    bad = crumpled(lump, 3.0, 100, 2000)
    places = crossings(bad, intersecting_pairs(bad))
    assert len(places) == 2
    for place in places:
        assert min(np.linalg.norm(lump.vertices[tip] - place.place) for tip in (100, 2000)) < 6.0
    good = repair_intersections(bad)
    assert len(intersecting_pairs(good)) == 0
    assert euler_characteristic(good.faces) == 2
    assert is_manifold(good.faces)
    assert surface_deviation(good, lump, 2000).maximum < 0.4
    kept = {tuple(p) for p in good.vertices}
    far = np.linalg.norm(bad.vertices[:, None] - lump.vertices[[100, 2000]][None], axis=2).min(axis=1) > 15.0
    assert all(tuple(p) in kept for p in bad.vertices[far])


def test_openings_stay_open():
    pipe = crumpled(tube(10.0, 40.0, 48, 33), 2.5, 500)
    assert len(intersecting_pairs(pipe)) > 0
    good = repair_intersections(pipe)
    assert len(intersecting_pairs(good)) == 0
    assert sorted(map(len, boundary_loops(good.faces))) == [48, 48]


def test_what_cannot_be_replaced_is_returned_as_it_is():
    ball = sphere(10.0, 2)
    both = joined(ball, TriMesh(ball.vertices + [15.0, 0.1, 0.2], ball.faces))
    assert repair_intersections(both) is both
