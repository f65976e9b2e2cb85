"""The numbering of a surface depends on nothing but the surface."""

from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, reflection
from ssmpipe.core.mesh.numbering import canonical, canonical_order
from ssmpipe.core.mesh.primitives import sphere, star_shape, tube
from ssmpipe.core.mesh.trimesh import TriMesh
from tests.support.meshes import bent_tube, random_motion, relabeled

MESHES = {"closed": star_shape(4), "open": bent_tube()}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", list(MESHES))
def test_pose_side_and_order_change_nothing(name: str, mirrored: bool, seed: int) -> None:
    rng, mesh = np.random.default_rng(seed), MESHES[name]
    matrix = random_motion(rng) @ (reflection(seed) if mirrored else np.eye(4))
    other = TriMesh(apply(matrix, mesh.vertices), mesh.faces[:, ::-1] if mirrored else mesh.faces)
    expected, turned = canonical(mesh)
    found, other_turned = canonical(relabeled(other, rng)[0])
    assert np.array_equal(found.faces, expected.faces)
    assert np.abs(found.vertices - apply(matrix, expected.vertices)).max() < 1e-11
    assert (other_turned != turned) is mirrored


def test_the_surface_stays_and_a_second_time_changes_nothing() -> None:
    mesh = MESHES["open"]
    found, turned = canonical(mesh)
    order, faces = canonical_order(mesh)
    assert np.array_equal(found.vertices, mesh.vertices[order])
    back = order[found.faces[:, ::-1] if turned else found.faces]
    lowest = np.argmin(back, axis=1)[:, None]
    same = np.take_along_axis(back, (lowest + np.arange(3)) % 3, axis=1)
    given = mesh.faces[faces]
    assert np.array_equal(same, np.take_along_axis(given, (np.argmin(given, 1)[:, None] + np.arange(3)) % 3, axis=1))
    again, turned_again = canonical(found)
    assert np.array_equal(again.faces, found.faces)
    assert not turned_again


@pytest.mark.parametrize("mesh", [sphere(1.0, 3), tube(1.0, 3.0, 24, 9)], ids=["sphere", "tube"])
def test_vertices_that_are_alike_stay_in_their_order(mesh: TriMesh) -> None:
    # seen from the middle of a tube whole rings are alike; rounding must not order them
    moved = TriMesh(apply(random_motion(np.random.default_rng(0)), mesh.vertices), mesh.faces)
    one, two = (canonical_order(m) for m in (mesh, moved))
    assert np.array_equal(one[0], two[0])
    assert np.array_equal(one[1], two[1])


def test_a_surface_without_area_is_no_error() -> None:
    line = TriMesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]]))
    assert sorted(canonical_order(line)[0]) == [0, 1, 2]
