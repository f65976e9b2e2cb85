from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import area, face_normals, volume
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import compact, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import check_handles, check_openings, clean, separate_fans
from ssmpipe.core.repair.trimming import cut_by_plane
from tests.support.meshes import box, joined, soup


def damaged() -> TriMesh:
    """Return a lump as a soup with every kind of damage that repair undoes."""
    rng = np.random.default_rng(0)
    lump = star_shape(3)
    faces = lump.faces.copy()
    flip = rng.choice(len(faces), 100, replace=False)
    faces[flip] = faces[flip, ::-1]
    raw = soup(TriMesh(lump.vertices, faces))
    duplicates = raw.faces[rng.choice(len(faces), 30, replace=False)]
    degenerate = np.column_stack([raw.faces[:20, 0], raw.faces[:20, 0], raw.faces[:20, 1]])
    tips = raw.vertices[raw.faces[200:215, 0]] * 1.3
    fins = np.column_stack([raw.faces[200:215, 1], raw.faces[200:215, 2], raw.n_vertices + np.arange(15)])
    vertices = np.vstack([raw.vertices, tips, [[500.0, 0, 0]]])  # the last one is loose
    body = TriMesh(vertices, np.vstack([raw.faces, duplicates, degenerate, fins]))
    speck = sphere(1.0, 1)
    return joined(body, TriMesh(speck.vertices + [90.0, 0, 0], speck.faces))


def test_every_damage_is_undone():
    lump = star_shape(3)
    cleaned = clean(damaged())
    assert cleaned.mesh.n_faces == lump.n_faces
    assert cleaned.mesh.n_vertices == lump.n_vertices
    assert volume(cleaned.mesh) == pytest.approx(volume(lump))
    assert is_manifold(cleaned.mesh.faces)
    assert cleaned.changes["duplicate_faces"] == 30
    assert cleaned.changes["degenerate_faces"] == 20
    assert cleaned.changes["fin_faces"] == 15
    assert cleaned.changes["dropped_components"] == 1
    assert cleaned.changes["unused_vertices"] == 1
    assert 0 < cleaned.dropped_area_fraction < 0.01


def test_a_clean_mesh_is_left_alone():
    lump = star_shape(3)
    again = clean(lump)
    assert not any(again.changes.values())
    assert np.array_equal(again.mesh.vertices, lump.vertices)
    assert np.array_equal(again.mesh.faces, lump.faces)


@pytest.mark.parametrize(
    "mesh",
    [star_shape(3), tube(), cut_by_plane(sphere(), np.array([0, 0, 0.5]), np.array([0, 0, 1.0]))],
    ids=["closed", "tube", "hole"],
)
def test_inside_out_is_turned(mesh):
    turned = clean(TriMesh(mesh.vertices, mesh.faces[:, ::-1]))
    assert volume(turned.mesh) == pytest.approx(volume(mesh))
    assert turned.changes["flipped_faces"] == mesh.n_faces


def test_cubes_that_share_an_edge_or_a_vertex_come_apart():
    for second in ((1.0, 1.0, 0.0), (1.0, 1.0, 1.0)):
        with pytest.raises(TopologyError, match=r"2 components of 50.0 %, 50.0 % of the area.*components: largest"):
            clean(joined(box((0, 0, 0)), box(second)))
        kept = clean(joined(box((0, 0, 0)), box(second)), components="largest").mesh
        assert euler_characteristic(kept.faces) == 2
        assert volume(kept) == pytest.approx(1.0)


def test_a_bow_tie_is_split():
    # two squares that touch in one corner, made one vertex
    square = flat_square(3)
    both = joined(square, TriMesh(square.vertices + [1.0, 1.0, 0.0], square.faces))
    faces = np.where(both.faces == 9, 8, both.faces)
    split, n = separate_fans(TriMesh(both.vertices, faces))
    assert n == 1
    assert is_manifold(compact(split).faces)


def test_refusals_say_what_and_where():
    with pytest.raises(TopologyError, match=r"1 of them inside the largest"):
        clean(joined(sphere(10.0), sphere(8.0)))
    with pytest.raises(TopologyError, match=r"1 handle \(genus 1\).*a loop of 6\.\d mm around one lies at \("):
        check_handles(torus())
    with pytest.raises(
        TopologyError, match=r"2 openings of 6\.3, 6\.3 mm length; a closed surface is expected.*max_openings"
    ):
        check_openings(tube(), 0)
    with pytest.raises(TopologyError, match=r"at most 1 expected"):
        check_openings(tube(), 1)
    check_openings(tube(), 2)
    check_handles(sphere())
    check_handles(tube())
    with pytest.raises(GeometryError, match=r"1 of 3 vertices have coordinates that are not finite"):
        TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(TopologyError, match=r"every face is degenerate"):
        clean(TriMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))


def test_a_moebius_band_is_refused():
    n = 30
    angle = 2 * np.pi * np.arange(n) / n
    center = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * 10
    across = np.column_stack([np.cos(angle) * np.cos(angle / 2), np.sin(angle) * np.cos(angle / 2), np.sin(angle / 2)])
    vertices = np.vstack([center - across, center + across])
    faces = []
    for k in range(n):
        a, b = k, k + n
        c, d = ((k + 1) % n, (k + 1) % n + n) if k + 1 < n else (n, 0)
        faces += [[a, c, d], [a, d, b]]
    with pytest.raises(TopologyError, match=r"one-sided"):
        clean(TriMesh(vertices, np.array(faces)))


def test_flat_pieces_keep_their_direction():
    square = flat_square(5)
    assert not any(clean(square).changes.values())
    assert area(clean(square).mesh) == pytest.approx(1.0)
    faces = square.faces.copy()
    faces[[0, 7, 20]] = faces[[0, 7, 20], ::-1]
    cleaned = clean(TriMesh(square.vertices, faces))
    assert cleaned.changes["flipped_faces"] == 3
    assert (face_normals(cleaned.mesh)[:, 2] > 0).all()
