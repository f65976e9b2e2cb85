from __future__ import annotations

import logging
import re

import numpy as np
import pytest

from ssmpipe.contract import Context
from ssmpipe.core.align.rigid import apply
from ssmpipe.core.mesh.operators import area, face_normals, volume
from ssmpipe.core.mesh.primitives import star_shape, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.flat_faces import flat_faces, remove_flat_faces
from ssmpipe.stages import repair
from tests.support.meshes import bent_tube, random_motion, relabeled, with_caps


def with_needles(mesh: TriMesh, vertices: list[int], gap: float) -> TriMesh:
    """Make two of some vertices, `gap` apart, with two needles between them."""
    points, faces = list(mesh.vertices), mesh.faces.tolist()
    for vertex in vertices:
        after = {}
        for k, face in enumerate(faces):
            if vertex in face:
                i = face.index(vertex)
                after[face[(i + 1) % 3]] = (k, face[(i + 2) % 3])
        corner = first = min(after)
        fan = []
        while not fan or corner != first:
            fan.append((corner, after[corner][0]))
            corner = after[corner][1]
        new, half = len(points), len(fan) // 2
        points.append(points[vertex] + gap * np.array([1.0, 0.0, 0.0]))
        for _, k in fan[:half]:
            faces[k][faces[k].index(vertex)] = new
        faces += [[fan[0][0], new, vertex], [fan[half][0], vertex, new]]
    return TriMesh(np.array(points), np.array(faces))


def rim_lengths(mesh: TriMesh) -> list[float]:
    return sorted(loop_length(mesh, loop) for loop in boundary_loops(mesh.faces))


def same_surface(found: TriMesh, expected: TriMesh, *, abs_mm: float = 1e-9) -> None:
    assert is_manifold(found.faces)
    assert euler_characteristic(found.faces) == euler_characteristic(expected.faces)
    assert area(found) == pytest.approx(area(expected), rel=1e-8)
    assert volume(found) == pytest.approx(volume(expected), rel=1e-8)
    assert rim_lengths(found) == pytest.approx(rim_lengths(expected), abs=abs_mm)


WHOLE = {"closed": star_shape(3), "handle": torus(), "tube": tube(), "bent tube": bent_tube()}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", list(WHOLE))
def test_caps_go_and_the_surface_stays(name, seed):
    mesh = with_caps(WHOLE[name], 150, seed)
    assert flat_faces(mesh).sum() >= 150
    done = remove_flat_faces(mesh)
    assert (done.n_before, done.n_left) == (int(flat_faces(mesh).sum()), 0)
    assert not flat_faces(done.mesh).any()
    assert done.mesh.n_vertices == mesh.n_vertices
    same_surface(done.mesh, WHOLE[name])


def test_a_vertex_that_came_to_lie_on_an_edge_stays_there():
    lump = star_shape(3)
    a, b, c = lump.faces[7]
    vertices = lump.vertices.copy()
    vertices[c] = 0.6 * vertices[a] + 0.4 * vertices[b]
    mesh = TriMesh(vertices, lump.faces)
    done = remove_flat_faces(mesh)
    assert (done.n_before, done.n_left) == (1, 0)
    assert np.array_equal(done.mesh.vertices, vertices)
    same_surface(done.mesh, mesh)
    assert (done.mesh.faces != lump.faces).any(axis=1).sum() == 2


def test_needles_become_vertices():
    lump = star_shape(3)
    mesh = with_needles(lump, [50, 200, 400], 1e-8)
    done = remove_flat_faces(mesh)
    assert (done.n_before, done.n_left) == (6, 0)
    assert (done.mesh.n_vertices, done.mesh.n_faces) == (lump.n_vertices, lump.n_faces)
    assert np.abs(done.mesh.vertices - lump.vertices).max() < 1e-8
    same_surface(done.mesh, lump)


def test_the_rim_keeps_its_place():
    pipe = tube(12.0, 30.0, n_around=24, n_along=10)
    (a, b), inner = boundary_loops(pipe.faces)[0][:2], boundary_loops(pipe.faces)[1]
    # a vertex on the rim with a face between it and the rim; a vertex beside one of the rim
    (k,) = np.flatnonzero((pipe.faces == a).any(axis=1) & (pipe.faces == b).any(axis=1))
    third = next(x for x in pipe.faces[k] if x not in (a, b))
    new, beside = pipe.n_vertices, pipe.n_vertices + 1
    faces = pipe.faces.tolist()
    (j,) = np.flatnonzero((pipe.faces == inner[0]).any(axis=1) & (pipe.faces == inner[1]).any(axis=1))
    last = next(x for x in pipe.faces[j] if x not in inner[:2])
    faces[k], faces[j] = [a, new, third], [beside, inner[1], last]
    faces += [[new, b, third], [a, b, new], [inner[0], inner[1], beside], [inner[0], beside, last]]
    points = [0.5 * (pipe.vertices[a] + pipe.vertices[b]), pipe.vertices[inner[0]] + 1e-9 * np.array([0.3, 0.2, 0.1])]
    mesh = TriMesh(np.vstack([pipe.vertices, points]), np.array(faces))
    assert is_manifold(mesh.faces)
    done = remove_flat_faces(mesh)
    assert done.n_left == 0
    same_surface(done.mesh, pipe)
    rims = np.concatenate(boundary_loops(done.mesh.faces))
    for corner in np.concatenate([boundary_loops(pipe.faces)[0], inner]):
        assert np.linalg.norm(done.mesh.vertices[rims] - pipe.vertices[corner], axis=1).min() == 0.0


def test_a_whisker_of_the_rim_goes():
    square = TriMesh(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1]]),
    )
    done = remove_flat_faces(square)
    assert (done.n_before, done.n_left) == (1, 0)
    assert done.mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def neck() -> TriMesh:
    """Return a prism of three storeys with a waist of three edges, one of which is very short."""
    angle = 2 * np.pi * np.arange(3) / 3
    vertices = np.vstack([np.column_stack([np.cos(angle), np.sin(angle), np.full(3, z)]) for z in range(4)])
    vertices[4] = vertices[3] + [0.0, 8e-7, 0.0]
    faces = [[0, 2, 1], [9, 10, 11]]
    for low in (0, 3, 6):
        for k in range(3):
            a, b = low + k, low + (k + 1) % 3
            faces += [[a, b, b + 3], [a, b + 3, a + 3]]
    return TriMesh(vertices, np.array(faces))


def test_what_would_change_the_topology_is_left_and_counted():
    mesh = neck()
    done = remove_flat_faces(mesh)
    same_surface(done.mesh, mesh)
    assert done.mesh.n_vertices == mesh.n_vertices
    assert done.n_left == int(flat_faces(done.mesh).sum()) > 0
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    repair.run(mesh=mesh, cfg=repair.Config(), ctx=ctx)
    assert ctx.metrics["flat_faces_left"] == done.n_left
    assert re.match(rf"{done.n_left} faces without area could not be removed: \(1\.0, 0\.0, 0\..\) mm", ctx.warnings[0])
    bag = TriMesh(
        np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1, 0.0]]),
        np.array([[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]]),
    )
    left = remove_flat_faces(bag)
    assert (left.n_before, left.n_left) == (1, 1)
    assert np.array_equal(left.mesh.faces, bag.faces)


def test_thin_faces_that_have_an_area_are_left_alone():
    lump = star_shape(3)
    mesh = with_caps(lump, 1)
    a, b, new = mesh.faces[-1]
    along = mesh.vertices[b] - mesh.vertices[a]
    across = np.cross(along, [0.3, 0.2, 0.1])
    for height, n_flat in ((0.5e-6, 1), (2e-6, 0)):
        vertices = mesh.vertices.copy()
        vertices[new] += height * np.linalg.norm(along) * across / np.linalg.norm(across)
        thin = TriMesh(vertices, mesh.faces)
        done = remove_flat_faces(thin)
        assert (done.n_before, done.mesh is thin) == (n_flat, n_flat == 0)
    assert remove_flat_faces(lump).mesh is lump


@pytest.mark.parametrize("name", ["closed", "bent tube"])
def test_pose_and_numbering_change_nothing(name):
    rng = np.random.default_rng(5)
    mesh = with_caps(WHOLE[name], 60)
    expected = remove_flat_faces(mesh).mesh
    matrix = random_motion(rng)
    moved = TriMesh(apply(matrix, mesh.vertices), mesh.faces)
    found = remove_flat_faces(moved).mesh
    assert np.array_equal(found.faces, expected.faces)
    assert found.vertices == pytest.approx(apply(matrix, expected.vertices), abs=1e-9)
    shuffled, new = relabeled(mesh, rng)
    found = remove_flat_faces(shuffled).mesh
    assert {frozenset(face) for face in found.faces.tolist()} == {
        frozenset(face) for face in new[expected.faces].tolist()
    }


def test_single_precision_of_a_scan_is_no_obstacle():
    lump = star_shape(4)
    mesh = with_needles(with_caps(lump, 100, 1), [5, 77], 1e-7)
    rounded = TriMesh(mesh.vertices.astype(np.float32).astype(np.float64), mesh.faces)
    done = clean(rounded)
    assert done.changes["flat_faces_left"] == 0
    assert not flat_faces(done.mesh).any()
    assert euler_characteristic(done.mesh.faces) == 2
    assert is_manifold(done.mesh.faces)
    assert volume(done.mesh) == pytest.approx(volume(lump), rel=1e-6)
    assert clean(done.mesh).mesh.faces.tolist() == done.mesh.faces.tolist()
    assert (face_normals(done.mesh) ** 2).sum(axis=1) == pytest.approx(np.ones(done.mesh.n_faces))
