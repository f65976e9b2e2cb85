from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import move
from ssmpipe.core.errors import FoldoverError, GeometryError, TopologyError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, tube
from ssmpipe.core.mesh.topology import euler_characteristic, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import (
    SQUARE_CORNERS,
    corners_by_angle,
    insert_corners,
    order_corners,
    rim_axes,
    rim_centroid,
    rim_of,
    split_chords,
    square_boundary,
)
from ssmpipe.core.parameterize.distortion import folded, global_stretch, squared_stretch, vertex_stretch
from ssmpipe.core.parameterize.harmonic import solve_averages
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.stretch import parameterize_square
from ssmpipe.core.parameterize.weights import neighbour_weights
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import noisy, random_motion, relabeled

UP = np.array([0, 0, 1.0])


def cup() -> TriMesh:
    """Return a disk that covers nearly a whole lump, as a trimmed femur does."""
    lump = star_shape(4)
    return trim(lump, np.array([0, 0, 35.0]), UP)


def mapped(mesh: TriMesh, **options):
    rim = rim_of(mesh)
    wanted = corners_by_angle(mesh, rim, (45, 135, 225, 315), np.eye(3)[:2])
    with_corners, corners, away = insert_corners(mesh, wanted)
    assert away == pytest.approx(0.0, abs=1e-9)
    disk = split_chords(with_corners)
    ordered = order_corners(rim_of(disk), corners)
    return disk, ordered, parameterize_square(disk, ordered, **options)


@pytest.mark.parametrize("weighting", ["mean-value", "harmonic"])
def test_a_flat_square_maps_to_itself(weighting):
    rng = np.random.default_rng(0)
    square = flat_square(12, 30.0)
    inner = np.setdiff1d(np.arange(144), rim_of(square))
    vertices = square.vertices.copy()
    vertices[inner, :2] += 0.5 * rng.uniform(-1, 1, (len(inner), 2))
    square = split_chords(TriMesh(vertices, square.faces))
    corners = np.array([0, 132, 143, 11])
    result = parameterize_square(square, order_corners(rim_of(square), corners), weighting=weighting)
    assert result.value == pytest.approx(square.vertices[:, :2] / 30.0, abs=1e-9)
    assert result.history["stretch"][-1] == pytest.approx(1.0)


def test_linear_functions_are_averages_of_their_neighbours():
    square = noisy(flat_square(8), np.random.default_rng(1), 0.02)
    square = TriMesh(square.vertices * [1, 1, 0], square.faces)
    inner = np.setdiff1d(np.arange(64), rim_of(square))
    for weighting in ("mean-value", "harmonic"):
        weights = neighbour_weights(square, weighting)
        mean = (weights @ square.vertices) / np.asarray(weights.sum(axis=1))
        assert mean[inner] == pytest.approx(square.vertices[inner])


def test_a_cup_maps_one_to_one_with_little_stretch():
    disk, corners, result = mapped(cup())
    assert not folded(result.value, disk.faces).any()
    assert np.array_equal(result.value[corners], SQUARE_CORNERS)
    stretch = result.history["stretch"]
    assert (np.diff(stretch) < 0).all()
    assert stretch[-1] < 1.3
    assert stretch[0] > 2.0
    assert stretch[-1] == pytest.approx(global_stretch(disk, result.value))
    assert result.status == "converged"
    samples = sample_grid(disk, result.value, 40, 40)
    assert samples[0, 0] == pytest.approx(disk.vertices[corners[0]])
    assert samples[-1, -1] == pytest.approx(disk.vertices[corners[2]])


def test_map_does_not_depend_on_pose_or_numbering():
    rng = np.random.default_rng(2)
    disk, corners, result = mapped(cup())
    motion = random_motion(rng)
    shuffled, new = relabeled(move(disk, motion), rng)
    other = parameterize_square(shuffled, new[corners])
    assert other.value[new] == pytest.approx(result.value, abs=1e-8)


def test_stretch_of_an_affine_map():
    square = flat_square(4)
    surface = TriMesh(square.vertices * [3.0, 4.0, 1.0], square.faces)
    uv = square.vertices[:, :2]
    assert squared_stretch(surface, uv) == pytest.approx(np.full(18, 12.5))
    assert vertex_stretch(surface, uv) == pytest.approx(np.full(16, np.sqrt(12.5)))
    assert global_stretch(surface, uv) == pytest.approx(np.sqrt(12.5 / 12.0))
    assert np.isinf(squared_stretch(surface, np.zeros((16, 2)))).all()


def test_boundary_goes_around_by_arc_length():
    even = flat_square(5)
    square = TriMesh(even.vertices**2, even.faces)
    rim, uv = square_boundary(square, np.array([0, 20, 24, 4]))
    assert uv == pytest.approx(square.vertices[rim, :2])


def test_corners_are_exact_places_and_keep_the_surface():
    cap = trim(sphere(10.0, 4), np.zeros(3), UP)
    wanted = corners_by_angle(cap, rim_of(cap), (31.0, 95.0, 200.0, 301.0), np.eye(3)[:2])
    angle = np.degrees(np.arctan2(wanted[:, 1], wanted[:, 0])) % 360
    assert angle == pytest.approx([31, 95, 200, 301], abs=0.2)
    refined, corners, _ = insert_corners(cap, wanted)
    assert refined.vertices[corners] == pytest.approx(wanted)
    assert area(refined) == pytest.approx(area(cap))
    assert euler_characteristic(refined.faces) == 1
    again, same, _ = insert_corners(refined, wanted)
    assert again is refined
    assert np.array_equal(same, corners)


def test_corners_follow_the_rim_and_refuse_disorder():
    rim = np.arange(10)
    assert list(order_corners(rim, np.array([1, 3, 5, 7]))) == [1, 3, 5, 7]
    assert list(order_corners(rim, np.array([7, 5, 3, 1]))) == [7, 1, 3, 5]
    with pytest.raises(GeometryError, match=r"do not follow each other"):
        order_corners(rim, np.array([1, 5, 3, 7]))
    with pytest.raises(GeometryError, match=r"same boundary vertex"):
        order_corners(rim, np.array([1, 1, 3, 7]))


def test_rim_of_an_ellipse():
    disk = flat_square(21)
    xy = 2 * disk.vertices[:, :2] - 1
    u, v = xy.T
    ellipse = np.column_stack([4 * u * np.sqrt(1 - v**2 / 2), 2 * v * np.sqrt(1 - u**2 / 2), 0 * u])
    mesh = TriMesh(ellipse, disk.faces)
    axes, ratio = rim_axes(mesh, rim_of(mesh))
    assert axes == pytest.approx(np.eye(3)[:2], abs=1e-6)
    assert 1.5 < ratio < 2.0
    assert rim_centroid(mesh, rim_of(mesh)) == pytest.approx(np.zeros(3), abs=1e-9)


def test_chords_are_divided_so_that_no_triangle_is_squashed():
    # three corners of the square's side in one face: without the division it has no area
    square = flat_square(4)
    chords = split_chords(square)
    edges = unique_edges(chords.faces)
    on_rim = np.zeros(chords.n_vertices, dtype=bool)
    on_rim[edges.vertices[edges.n_faces == 1]] = True
    assert not ((edges.n_faces == 2) & on_rim[edges.vertices].all(axis=1)).any()
    assert area(chords) == pytest.approx(1.0)


def test_refusals():
    with pytest.raises(TopologyError, match=r"2 boundary loops"):
        rim_of(tube())
    with pytest.raises(TopologyError, match=r"0 boundary loops.*trim"):
        rim_of(sphere())
    # a vertex far outside of its ring gives negative cotangent weights
    disk, corners, _ = mapped(cup())
    rng = np.random.default_rng(3)
    spiky = noisy(disk, rng, 6.0)
    with pytest.raises(
        FoldoverError, match=r"\d+ of \d+ triangles are turned over in the square, the first at .*mean-value"
    ):
        parameterize_square(spiky, corners, weighting="harmonic")
    assert not folded(parameterize_square(spiky, corners).value, spiky.faces).any()
    with pytest.raises(GeometryError, match=r"grid points lie outside"):
        sample_grid(flat_square(3), flat_square(3).vertices[:, :2] * 0.5, 5, 5)


def test_averages_hold_at_the_solution():
    square = flat_square(6)
    weights = neighbour_weights(square, "uniform")
    rim = rim_of(square)
    solved = solve_averages(weights, rim, square.vertices[rim])
    inner = np.setdiff1d(np.arange(36), rim)
    mean = (weights @ solved) / np.asarray(weights.sum(axis=1))
    assert mean[inner] == pytest.approx(solved[inner])


def test_samples_reproduce_a_flat_square():
    square = flat_square(7, 12.0)
    samples = sample_grid(square, square.vertices[:, :2] / 12.0, 9, 5)
    assert samples[..., 0] == pytest.approx(np.broadcast_to(np.linspace(0, 12, 9)[:, None], (9, 5)))
    assert samples[..., 1] == pytest.approx(np.broadcast_to(np.linspace(0, 12, 5)[None], (9, 5)))
