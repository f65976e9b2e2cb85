import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import face_normals, vertex_normals
from ssmpipe.core.mesh.primitives import star_shape
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.guided_filling import fill_towards


def cut(whole: TriMesh, share: float) -> TriMesh:
    level = np.quantile(whole.vertices[:, 2], share)
    return compact(whole, (whole.vertices[whole.faces][:, :, 2] < level).all(axis=1))


@pytest.mark.parametrize("share", [0.9, 0.6])
def test_the_patch_is_where_the_target_says_and_what_was_there_stays(share):
    whole = star_shape(3)
    part = cut(whole, share)
    filled, (new,) = fill_towards(part, boundary_loops(part.faces), whole)
    assert np.array_equal(filled.vertices[: part.n_vertices], part.vertices)
    assert np.array_equal(filled.faces[: part.n_faces], part.faces)
    assert boundary_loops(filled.faces) == []
    assert is_manifold(filled.faces)
    assert euler_characteristic(filled.faces) == 2
    size = np.ptp(whole.vertices, axis=0).max()
    off = point_to_mesh(filled.vertices[new], whole)[0]
    assert off.max() < 0.01 * size
    back = point_to_mesh(whole.vertices, filled)[0]
    assert back.max() < 0.03 * size, "nothing of the target is left out"


def test_a_target_that_is_off_is_blended_into_the_rim():
    whole = star_shape(3)
    part = cut(whole, 0.8)
    lifted = TriMesh(whole.vertices + 0.02 * np.ptp(whole.vertices) * vertex_normals(whole), whole.faces)
    filled, (new,) = fill_towards(part, boundary_loops(part.faces), lifted)
    patch = filled.faces[part.n_faces :]
    at_rim = (patch < part.n_vertices).any(axis=1)
    turn = np.einsum("ij,ij->i", face_normals(filled)[part.n_faces :], face_normals(whole)[
        point_to_mesh(filled.vertices[patch].mean(axis=1), whole)[1]
    ])  # fmt: skip
    assert np.percentile(turn[at_rim], 5) > 0.8, "no step at the rim"
    top = filled.vertices[new][filled.vertices[new][:, 2].argmax()]
    assert point_to_mesh(top[None], lifted)[0][0] < 0.25 * point_to_mesh(top[None], whole)[0][0]


def test_a_patch_that_finds_no_surface_is_refused():
    whole = star_shape(3)
    part = cut(whole, 0.6)
    size = float(np.ptp(whole.vertices))
    wall = TriMesh(size * np.array([[-9, -9, 3], [9, -9, 3], [0, 9, 3.0]]), np.array([[0, 1, 2]]))
    with pytest.raises(GeometryError, match="does not come to rest"):
        fill_towards(part, boundary_loops(part.faces), TriMesh(wall.vertices * 0.02 + [0, 0, 3 * size], wall.faces))
