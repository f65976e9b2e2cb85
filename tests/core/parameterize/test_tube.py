from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import move
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import flat_square, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import split_chords
from ssmpipe.core.parameterize.cutting import cut_along, shortest_path
from ssmpipe.core.parameterize.distortion import folded
from ssmpipe.core.parameterize.generatrix import cut_tube, rims_of
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.core.parameterize.tube import _rejoined, parameterize_tube
from tests.support.meshes import bent_tube

X, Y, Z = np.eye(3)


def cut(mesh, side=Y, axis=None, through=None, path_by="edges"):
    rim_1, rim_2, _ = rims_of(mesh, axis=axis)
    return cut_tube(mesh, (rim_1, rim_2), through=through, side=side, path_by=path_by)[0]


def test_a_cylinder_unrolls_isometrically():
    pipe = tube(radius=2.0, height=7.0, n_around=24, n_along=15)
    made = cut(pipe, axis=Z, side=X)
    for sides in ("periodic", "straight"):
        result = parameterize_tube(made.mesh, made.seam, sides=sides)
        assert result.history["stretch"][-1] == pytest.approx(1.0, abs=5e-3)  # the chords of the circle, not the map
        points, uv = made.mesh.vertices, result.value
        assert uv[:, 1] == pytest.approx(points[:, 2] / 7.0, abs=1e-9)
        angle = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        assert np.abs((uv[:, 0] - angle + 0.5) % 1.0 - 0.5).max() < 1e-9
    assert made.length == pytest.approx(7.0)


@pytest.mark.parametrize("sides", ["periodic", "straight"])
def test_a_bent_tube_is_mapped_without_folds(sides):
    made = cut(bent_tube())
    mesh = split_chords(made.mesh) if sides == "straight" else made.mesh
    assert euler_characteristic(mesh.faces) == 1
    assert len(boundary_loops(mesh.faces)) == 1
    result = parameterize_tube(mesh, made.seam, sides=sides)
    uv, stretch = result.value, result.history["stretch"]
    assert not folded(uv, mesh.faces).any()
    assert (np.diff(stretch) < 0).all()
    assert stretch[-1] < stretch[0] < 1.2
    left, right = made.seam.pairs.T
    assert np.array_equal(uv[left, 1], uv[right, 1])
    assert np.array_equal(uv[left, 0] + 1.0, uv[right, 0])
    assert (uv[left[[0, -1]]] == [[0, 0], [0, 1]]).all()
    assert (np.diff(uv[left, 1]) > 0).all()
    if sides == "straight":
        assert (uv[left, 0] == 0).all()
    samples = sample_grid(mesh, uv, 21, 31, made.seam)
    assert np.array_equal(samples[0], samples[-1])
    for column in (0, -1):
        steps = np.linalg.norm(np.diff(samples[:, column], axis=0), axis=1)
        assert steps.max() < 1.05 * steps.min()  # by arc length
    # u, v and the outward normal are right-handed
    s_u, s_v = np.gradient(samples, axis=(0, 1))
    axis = samples[:-1].mean(axis=0)
    assert (np.einsum("ijk,ijk->ij", np.cross(s_u, s_v), samples - axis)[1:-1] > 0).all()


def test_the_periodic_map_does_not_see_where_the_seam_runs():
    mesh = bent_tube()
    rims = rims_of(mesh)[:2]
    made = cut_tube(mesh, rims, side=Y)[0]
    whole = TriMesh(made.mesh.vertices[: -len(made.seam.pairs)], _rejoined(made.mesh, made.seam)[1].faces)
    path = made.seam.pairs[:, 0]
    inner = np.setdiff1d(np.concatenate(boundary_loops(whole.faces)), path[[0, -1]])
    detour = shortest_path(TriMesh(whole.vertices * [1, 0.2, 1], whole.faces), path[0], path[-1:], inner)
    assert not np.array_equal(detour, path)
    other = cut_along(whole, detour)
    uv = [parameterize_tube(made.mesh, made.seam).value, parameterize_tube(other.mesh, Seam("tube", other.pairs)).value]
    difference = uv[0][: whole.n_vertices] - uv[1][: whole.n_vertices]
    np.testing.assert_allclose(difference - np.round(difference), 0.0, atol=1e-9)
    assert np.abs(np.round(difference[:, 0])).max() == 1


def test_rigid_motion_and_vertex_order_change_nothing():
    mesh = bent_tube()
    made = cut(mesh)
    uv = parameterize_tube(made.mesh, made.seam).value
    grid = sample_grid(made.mesh, uv, 9, 9, made.seam)
    angle = 0.7
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:3, 3] = [3.0, -2.0, 5.0]
    order = np.random.default_rng(3).permutation(mesh.n_vertices)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    other = move(TriMesh(mesh.vertices[order], place[mesh.faces]), turn)
    made = cut(other, side=turn[:3, :3] @ Y)
    again = sample_grid(made.mesh, parameterize_tube(made.mesh, made.seam).value, 9, 9, made.seam)
    np.testing.assert_allclose(again, grid @ turn[:3, :3].T + turn[:3, 3], atol=1e-6)


def test_rims_are_ordered_by_landmark_axis_or_length():
    pipe = bent_tube()  # the rim at z = 0 is longer
    first, second, clear = rims_of(pipe)
    assert pipe.vertices[first, 2].mean() < pipe.vertices[second, 2].mean()
    assert clear > 0.1
    assert np.array_equal(rims_of(pipe, axis=-Z)[0], second)
    far = pipe.vertices[second[0]]
    assert np.array_equal(rims_of(pipe, (far, None))[0], second)
    assert np.array_equal(rims_of(pipe, (None, far))[0], first)


def test_the_seam_runs_through_the_landmark_or_on_the_side():
    pipe = bent_tube()
    mark = pipe.vertices[np.argmin(np.linalg.norm(pipe.vertices - [8.0, -3.5, 12.0], axis=1))]
    made = cut(pipe, through=mark)
    assert (made.mesh.vertices[made.seam.pairs[:, 0]] == mark).all(axis=1).any()
    sides = [cut(pipe, side=s) for s in (Y, -Y)]
    for one, sign in zip(sides, (1, -1), strict=True):
        ends = one.mesh.vertices[one.seam.pairs[[0, -1], 0]]
        assert (sign * ends[:, 1] > 2.5).all()
        assert np.isin(one.seam.pairs[1:-1], np.concatenate(boundary_loops(pipe.faces))).sum() == 0


@pytest.mark.parametrize("through", [None, [8.0, -3.5, 12.0]])
def test_a_geodesic_cut_is_shorter_and_maps_as_well(through):
    pipe = bent_tube()
    mark = None if through is None else pipe.vertices[np.argmin(np.linalg.norm(pipe.vertices - through, axis=1))]
    by_edges, straight = (cut(pipe, through=mark, path_by=way) for way in ("edges", "geodesic"))
    assert 0.9 * by_edges.length < straight.length < 0.995 * by_edges.length
    assert euler_characteristic(straight.mesh.faces) == 1
    assert len(boundary_loops(straight.mesh.faces)) == 1
    assert area(straight.mesh) == pytest.approx(area(pipe), rel=1e-12)
    seam = straight.mesh.vertices[straight.seam.pairs[:, 0]]
    assert np.array_equal(seam, straight.mesh.vertices[straight.seam.pairs[:, 1]])
    if mark is not None:
        assert (seam == mark).all(axis=1).any()
    result = parameterize_tube(straight.mesh, straight.seam)
    assert not folded(result.value, straight.mesh.faces).any()
    assert result.history["stretch"][-1] < 1.2


def test_a_geodesic_does_not_see_the_triangles():
    # the other diagonal in every cell of a tube: a straight line along it is no path of edges
    pipe = tube(5.0, 20.0, 40, 21)
    skew = TriMesh(
        pipe.vertices @ np.array([[np.cos(1.0), np.sin(1.0), 0], [-np.sin(1.0), np.cos(1.0), 0], [0, 0, 1]]), pipe.faces
    )
    turned = np.arctan2(skew.vertices[:, 1], skew.vertices[:, 0]) + 0.08 * skew.vertices[:, 2]
    helical = TriMesh(np.column_stack([5 * np.cos(turned), 5 * np.sin(turned), skew.vertices[:, 2]]), pipe.faces)
    lengths = [cut(helical, axis=Z, side=X, path_by=way).length for way in ("edges", "geodesic")]
    assert lengths[0] > 20.3
    assert lengths[1] == pytest.approx(20.0, abs=0.05)


def test_what_is_not_a_tube_is_refused():
    with pytest.raises(TopologyError, match="has 1 boundary loops, a tube has two"):
        rims_of(flat_square(5))
    pipe = tube(n_around=12, n_along=9)
    with pytest.raises(TopologyError, match="has 3 boundary loops, a tube has two") as caught:
        rims_of(TriMesh(pipe.vertices, np.delete(pipe.faces, 60, axis=0)))
    assert "fill-holes" in caught.value.remedy
    ring = torus(n_major=16, n_minor=12)
    loose = TriMesh(ring.vertices, np.delete(ring.faces, [0, 100], axis=0))
    with pytest.raises(TopologyError, match="Euler characteristic -2"):
        rims_of(loose)
    with pytest.raises(GeometryError, match="falls on a rim of the tube"):
        cut(pipe, through=pipe.vertices[0])
    with pytest.raises(GeometryError, match="runs along the tube"):
        cut(pipe, side=Z)
    made = cut(pipe, side=X)
    with pytest.raises(TopologyError, match="do not belong together"):
        parameterize_tube(pipe, Seam("tube", made.seam.pairs % pipe.n_vertices))
    with pytest.raises(TopologyError, match="from right to left"):
        parameterize_tube(made.mesh, Seam("tube", made.seam.pairs[:, ::-1]))
