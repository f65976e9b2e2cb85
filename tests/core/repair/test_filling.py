from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import vertex_normals, volume
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape
from ssmpipe.core.mesh.topology import boundary_loops, compact, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import points_outward
from ssmpipe.core.repair.filling import _check_patch, fill
from tests.support.meshes import random_motion, relabeled


def pierced(mesh: TriMesh, at: np.ndarray, radius: float) -> TriMesh:
    """Return the mesh without the faces near a point."""
    far = np.linalg.norm(mesh.vertices - at, axis=1) > radius
    return compact(mesh, far[mesh.faces].all(axis=1))


def closed(mesh: TriMesh, **options) -> TriMesh:
    return fill(mesh, boundary_loops(mesh.faces), **options)[0]


def distances(filled: TriMesh, holed: TriMesh, truth: TriMesh) -> np.ndarray:
    return point_to_mesh(filled.vertices[holed.n_vertices :], truth)[0]


LUMP = star_shape(5)
HOLED = pierced(LUMP, LUMP.vertices[100], 5.0)


@pytest.mark.parametrize("method", ["auto", "implicit", "biharmonic", "membrane"])
def test_a_patch_closes_the_hole_and_leaves_the_rest(method):
    filled = closed(HOLED, method=method)
    assert euler_characteristic(filled.faces) == 2
    assert is_manifold(filled.faces)
    assert points_outward(filled)
    assert np.array_equal(filled.vertices[: HOLED.n_vertices], HOLED.vertices)
    assert np.array_equal(filled.faces[: HOLED.n_faces], HOLED.faces)


def test_what_is_filled_is_filled_once():
    filled = closed(HOLED)
    again, patches = fill(filled, boundary_loops(filled.faces))
    assert np.array_equal(again.vertices, filled.vertices)
    assert np.array_equal(again.faces, filled.faces)
    assert patches == []


def test_a_hole_in_a_plane_is_filled_flat():
    square = flat_square(31, 30.0)
    holed = pierced(square, np.array([14.0, 16.0, 0.0]), 6.2)
    inner = min(boundary_loops(holed.faces), key=len)
    filled, _ = fill(holed, [inner])
    assert np.abs(filled.vertices[:, 2]).max() < 1e-9
    assert len(boundary_loops(filled.faces)) == 1


@pytest.mark.parametrize(("sigma", "rms"), [(0.0, 0.03), (0.1, 0.1), (0.2, 0.2)])
def test_curvature_is_continued_through_noise(sigma, rms):
    ball = sphere(10.0, 5)
    noise = sigma * np.random.default_rng(1).normal(size=(ball.n_vertices, 1))
    rough = TriMesh(ball.vertices + noise * vertex_normals(ball), ball.faces)
    holed = pierced(rough, ball.vertices[200], 5.0)
    away = distances(closed(holed), holed, ball)
    assert np.sqrt((away**2).mean()) < rms
    # a flat patch would be off by more than a millimetre
    assert np.sqrt((distances(closed(holed, method="membrane"), holed, ball) ** 2).mean()) > 0.6


def test_the_noise_is_estimated():
    ball = sphere(10.0, 5)
    noise = 0.1 * np.random.default_rng(1).normal(size=(ball.n_vertices, 1))
    rough = TriMesh(ball.vertices + noise * vertex_normals(ball), ball.faces)
    holed = pierced(rough, ball.vertices[200], 4.0)
    _, (patch,) = fill(holed, boundary_loops(holed.faces))
    assert patch.noise == pytest.approx(0.1, rel=0.15)
    assert patch.radius == pytest.approx(10.0, rel=0.02)
    assert 7 < patch.width < 11


def test_a_rigid_motion_moves_the_patch():
    motion = random_motion(np.random.default_rng(3))
    moved = closed(TriMesh(apply(motion, HOLED.vertices), HOLED.faces))
    still = closed(HOLED)
    assert np.abs(moved.vertices - apply(motion, still.vertices)).max() < 1e-6


def test_a_mirror_mirrors_the_patch():
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored = closed(TriMesh(apply(flip, HOLED.vertices), HOLED.faces[:, ::-1]))
    away = point_to_mesh(apply(flip, mirrored.vertices), closed(HOLED))[0]
    assert away.max() < 1e-9
    assert volume(mirrored) == pytest.approx(volume(closed(HOLED)), rel=1e-12)


def test_the_order_of_vertices_does_not_matter():
    shuffled, _ = relabeled(HOLED, np.random.default_rng(5))
    away = point_to_mesh(closed(shuffled).vertices, closed(HOLED))[0]
    assert away.max() < 1e-9


@pytest.mark.parametrize("n_faces", [1, 2, 3])
def test_holes_of_a_few_edges_close(n_faces):
    faces = LUMP.faces
    gone = np.zeros(len(faces), dtype=bool)
    seed = faces[0]
    gone[0] = True
    for k in range(n_faces - 1):
        side = np.sort([seed[k], seed[(k + 1) % 3]])
        gone |= np.isin(faces, side).sum(axis=1) == 2
    filled = closed(compact(LUMP, ~gone))
    assert euler_characteristic(filled.faces) == 2
    assert is_manifold(filled.faces)


def test_loops_that_touch_are_refused():
    # two triangles away from each other at one vertex
    around = np.flatnonzero((LUMP.faces == 0).any(axis=1))
    first = around[0]
    apart = [f for f in around if len(np.intersect1d(LUMP.faces[f], LUMP.faces[first])) == 1]
    torn = compact(LUMP, np.setdiff1d(np.arange(LUMP.n_faces), [first, apart[0]]))
    with pytest.raises(
        TopologyError, match=r"boundary loops touch at 1 vertices, the first at .* mm; try: run stage repair"
    ):
        closed(torn)


def test_a_concave_hole_is_not_folded():
    square = flat_square(41, 40.0)
    x, y = square.vertices[:, 0] - 20.0, square.vertices[:, 1] - 20.0
    bent = (np.hypot(x, y) < 12) & (np.hypot(x, y) > 8) & ~((x > 0) & (np.abs(y) < 4))
    holed = compact(square, ~bent[square.faces].any(axis=1))
    inner = [x for x in boundary_loops(holed.faces) if np.hypot(*(holed.vertices[x] - 20.0)[0, :2]) < 15]
    filled, _ = fill(holed, inner)
    assert is_manifold(filled.faces)
    corner = filled.vertices[filled.faces[holed.n_faces :]]
    signed = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2]
    # single slivers at the corners of the stairs of the rim may turn over
    assert -signed[signed < 0].sum() < 1e-3 * signed.sum()
    assert np.abs(filled.vertices[:, 2]).max() < 1e-9


def test_a_folded_patch_is_refused():
    angle = np.pi / 3 * np.arange(6)
    flat = np.vstack([np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]), np.zeros((1, 3))])
    fan = np.column_stack([np.arange(6), np.roll(np.arange(6), -1), np.full(6, 6)])
    _check_patch(flat, fan, 6.0, np.zeros(3))
    fan[0] = fan[0, ::-1]
    with pytest.raises(
        GeometryError, match=r"hole of 6\.0 mm at \(0\.0, 0\.0, 0\.0\) mm would be folded \(17 % of its area\)"
    ):
        _check_patch(flat, fan, 6.0, np.zeros(3))
