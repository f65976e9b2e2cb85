from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.icp import PointSurface, align, cost, distance, fits_better_mirrored
from ssmpipe.core.align.medoid import distribution_distances, medoid
from ssmpipe.core.align.rigid import homogeneous, move, reflection, rotation_angle
from ssmpipe.core.mesh.primitives import sphere, star_shape, tube
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import noisy, random_motion, relabeled


def test_a_known_motion_is_recovered_from_any_pose():
    lump, rng = star_shape(3), np.random.default_rng(0)
    other, _ = relabeled(noisy(lump, rng, 0.05), rng)
    for _ in range(20):
        motion = random_motion(rng)
        result = align(move(other, motion), lump, n_points=1500)
        rest = result.matrix @ motion
        assert rotation_angle(rest) < 0.3
        assert np.linalg.norm(rest[:3, 3]) < 0.3
        assert np.linalg.det(result.matrix[:3, :3]) == pytest.approx(1.0)
        assert result.converged


def test_open_pieces_align_too():
    piece, rng = trim(star_shape(4), np.zeros(3), np.array([0, 0.3, 1.0])), np.random.default_rng(1)
    motion = random_motion(rng)
    assert rotation_angle(align(move(piece, motion), piece).matrix @ motion) < 1e-3


def test_what_stands_out_beyond_an_open_end_counts():
    """A pose in which a tube has slid out of the other one is no better, however well it fits along the normals."""
    pipe = PointSurface.of(tube(5.0, 40.0), 2000)
    slid = homogeneous(np.eye(3), np.array([0.0, 0.0, 15.0]))
    assert cost(pipe, pipe, slid) < 0.3
    assert distance(pipe, pipe, slid) > 4.0


def test_the_given_pose_stays_unless_clearly_wrong():
    lump = star_shape(3)
    result = align(lump, lump)
    assert result.start == "identity"
    assert result.matrix == pytest.approx(np.eye(4), abs=1e-9)
    turned = move(lump, np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert align(turned, lump).start != "identity"


def test_same_bits_every_time():
    lump, other = star_shape(3), noisy(star_shape(3), np.random.default_rng(2), 0.3)
    assert np.array_equal(align(other, lump).matrix, align(other, lump).matrix)


def test_wrong_side_is_seen():
    lump = star_shape(3)
    right = align(lump, lump)
    assert not fits_better_mirrored(lump, lump, right)[0]
    mirrored = move(lump, reflection())
    wrong = align(mirrored, lump)
    assert fits_better_mirrored(mirrored, lump, wrong)[0]


def test_medoid_is_the_middle_size_in_any_pose():
    for seed in range(6):
        rng = np.random.default_rng(seed)
        meshes = {
            name: move(TriMesh(size * star_shape(3).vertices, star_shape(3).faces), random_motion(rng))
            for name, size in (("a", 0.8), ("b", 1.3), ("c", 1.0), ("d", 1.1))
        }
        assert medoid(meshes) == "c"  # the sums of c and d differ by rounding
    distances = distribution_distances({"x": sphere(1.0), "y": move(sphere(1.0), random_motion(rng)), "z": sphere(2.0)})
    assert distances[0, 1] == pytest.approx(0.0, abs=1e-9)
    # the mean distance of two points on a sphere is 4/3 of its radius
    assert distances[0, 2] == pytest.approx(4 / 3, rel=1e-2)


def club(size: float) -> TriMesh:
    """A rod with one slightly thicker end, 200 mm long at size 1."""
    ball = sphere(1.0, 4)
    z = ball.vertices[:, 2]
    radius = 10.0 + 2.0 * np.exp(-((z - 0.8) ** 2) / 0.05) + 1.0 * np.exp(-((z + 0.6) ** 2) / 0.1)
    across = ball.vertices[:, :2] * radius[:, None]
    return TriMesh(size * np.column_stack([across * [1.0, 0.7], 100.0 * z]), ball.faces)


def test_a_small_rod_is_not_turned_end_for_end():
    large, small = club(1.0), club(0.7)
    turned = move(small, np.diag([1.0, -1.0, -1.0, 1.0]))
    result = align(turned, large, n_points=1500)
    ends = result.matrix[:3, :3] @ np.array([0, 0, 1.0])
    assert ends[2] < -0.99
    assert result.scale == pytest.approx(1 / 0.7, rel=0.01)
    assert np.linalg.det(result.matrix[:3, :3]) == pytest.approx(1.0)
    # at its own size it fits inside of the large one either way round
    kept = align(turned, large, n_points=1500, scaled=False)
    assert kept.cost == pytest.approx(kept.identity_cost, rel=0.1)
