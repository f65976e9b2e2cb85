from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.primitives import flat_square, tube
from ssmpipe.core.mesh.topology import boundary_loops, compact, face_components, is_manifold, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import separate_fans
from ssmpipe.core.repair.stump import Stump, distance_from, flatten, girths, remove, stump_base


def chimney(height: float = 6.0, radius: float = 2.0, size: float = 20.0) -> TriMesh:
    """Return a round plate from which a tube rises, open at its top."""
    n = 48
    profile = [(radius, z) for z in np.arange(height, 0.0, -0.25)] + [(r, 0.0) for r in np.arange(radius, size, 0.25)]
    r, z = np.array(profile).T
    angle = 2 * np.pi * np.arange(n) / n
    points = np.stack(
        [np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.repeat(z[:, None], n, axis=1)], axis=-1
    )
    i, j = np.meshgrid(np.arange(len(r) - 1), np.arange(n), indexing="ij")
    a, b = i * n + j, i * n + (j + 1) % n
    faces = np.stack([np.stack([a, a + n, b], axis=-1), np.stack([b, a + n, b + n], axis=-1)], axis=2)
    return TriMesh(points.reshape(-1, 3), faces.reshape(-1, 3))


def shortest(mesh):
    return min(boundary_loops(mesh.faces), key=lambda loop: loop_length(mesh, loop))


def longest(mesh):
    return max(boundary_loops(mesh.faces), key=lambda loop: loop_length(mesh, loop))


def test_girths_on_a_tube_are_its_circumference():
    pipe = tube(2.0, 10.0, 60, 41)
    loop = boundary_loops(pipe.faces)[0]
    lines = girths(pipe, distance_from(pipe, loop, 20.0), np.array([1.1, 3.3, 7.7]))
    assert lines == pytest.approx(2 * np.pi * 2.0, rel=0.01)


def test_a_stump_is_told_from_a_hole():
    mesh = chimney()
    base = stump_base(mesh, shortest(mesh), 20.0)
    assert base is not None
    assert 5.0 < base < 10.0
    wall = flat_square(61, 30.0)
    far = np.linalg.norm(wall.vertices - [15, 15, 0], axis=1) > 3.0
    holed = compact(wall, far[wall.faces].all(axis=1))
    assert stump_base(holed, shortest(holed), 20.0) is None


def test_a_stump_is_flattened():
    mesh = chimney()
    outer = longest(mesh)
    flat, holes, stumps = flatten(mesh, [outer])
    assert len(holes) == len(stumps) == 1
    assert is_manifold(flat.faces)
    assert np.abs(flat.vertices[:, 2]).max() < 1e-9
    untouched, same, none = flatten(mesh, [outer], search=False)
    assert untouched is mesh
    assert len(same) == 1
    assert none == []


def test_ragged_openings_far_away_are_left_alone():
    mesh = chimney()
    rng = np.random.default_rng(0)
    outside = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1)[:, :2], axis=1) > 19.0
    ragged, _ = separate_fans(compact(mesh, ~(outside & (rng.random(mesh.n_faces) < 0.5))))
    label = face_components(ragged.faces)
    ragged = compact(ragged, label == np.bincount(label).argmax())
    outer = longest(ragged)
    flat, _, stumps = flatten(ragged, [outer])
    assert len(stumps) == 1
    assert any(len(loop) == len(outer) for loop in boundary_loops(flat.faces))


def test_marks_and_refusals():
    mesh = chimney()
    outer = longest(mesh)
    mark = mesh.vertices[shortest(mesh)[0]]
    flat, holes, _ = flatten(mesh, [outer], marks=[mark], mark_radius=12.0, search=False)
    assert len(holes) == 1
    assert np.abs(flat.vertices[:, 2]).max() < 1e-9
    with pytest.raises(TopologyError, match=r"does not open within 4 mm; try: raise fill-holes\.stump_reach_mm"):
        flatten(mesh, [outer], reach=4.0)
    with pytest.raises(TopologyError, match=r"removing 1 stumps leaves \d+ % of the surface"):
        remove(mesh, [Stump(shortest(mesh), 22.0)])
    wall = flat_square(61, 30.0)
    far = np.linalg.norm(wall.vertices - [15, 15, 0], axis=1) > 3.0
    holed = compact(wall, far[wall.faces].all(axis=1))
    rim = longest(holed)
    with pytest.raises(TopologyError, match="no widening was found"):
        flatten(holed, [rim], marks=[np.array([15.0, 12.0, 0.0])])
