from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply
from ssmpipe.core.mesh.primitives import sphere
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.spikes import find_spikes, remove_spikes
from ssmpipe.core.repair.trimming import cut_by_plane
from tests.support.femora import femur, needs_femora
from tests.support.meshes import implicit_surface, random_motion, relabeled


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=1) - 20.0


def bar(p: np.ndarray, start, end, radius: float) -> np.ndarray:
    start, along = np.array(start), np.subtract(end, start)
    t = np.clip((p - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - start - t[:, None] * along, axis=1) - radius


def with_bar(end, radius: float) -> TriMesh:
    return clean(implicit_surface(lambda p: np.minimum(ball(p), bar(p, (0.0, 0, 0), end, radius)), 28.0, 49)).mesh


NEEDLE = with_bar((26.0, 2.0, 3.0), 1.2)


def test_a_needle_is_removed_to_its_base():
    assert np.abs(ball(NEEDLE.vertices)).max() > 7.0
    (spike,) = find_spikes(NEEDLE)
    assert spike.length == pytest.approx(7.5, abs=1.2)  # along the surface, to the middle of the rounded base
    assert spike.width == pytest.approx(2.4, abs=0.6)
    after, removed = remove_spikes(NEEDLE, [spike])
    assert removed == [spike]
    assert np.abs(ball(after.vertices)).max() < 0.2
    assert euler_characteristic(after.faces) == 2
    assert is_manifold(after.faces)
    assert find_spikes(after) == []
    far = NEEDLE.vertices[NEEDLE.vertices[:, 0] < 15.0]
    assert {tuple(p) for p in far} <= {tuple(p) for p in after.vertices}


def test_one_vertex_pulled_out_is_a_needle():
    smooth = sphere(20.0, 4)
    vertices = smooth.vertices.copy()
    vertices[[100, 900]] *= [[1.4], [1.3]]
    pulled = TriMesh(vertices, smooth.faces)
    spikes = find_spikes(pulled)
    assert [s.tip for s in spikes] == [100, 900]
    after, removed = remove_spikes(pulled, spikes)
    assert len(removed) == 2
    assert np.abs(ball(after.vertices)).max() < 0.1


def wall(p: np.ndarray) -> np.ndarray:
    """Return a ball with a wall of 1.6 mm, little more than an edge, with two corners."""
    x, y, z = np.abs(p).T
    return np.minimum(ball(p), np.max([z - 0.8, y - 6.0, x - 27.0], axis=0))


@pytest.mark.parametrize("end", [(23.0, 2.0, 3.0), (25.5, 2.0, 3.0)])
def test_an_osteophyte_stays(end):
    assert find_spikes(with_bar(end, 2.8)) == []


def test_a_thin_wall_and_its_corners_stay():
    assert find_spikes(clean(implicit_surface(wall, 28.0, 49)).mesh) == []


def test_openings_stay_and_a_spike_on_the_rim_too():
    opened = cut_by_plane(NEEDLE, np.array([-5.0, 0, 0]), np.array([-1.0, 0, 0]))
    (rim,) = boundary_loops(opened.faces)
    after, removed = remove_spikes(opened, find_spikes(opened))
    assert len(removed) == 1
    (again,) = boundary_loops(after.faces)
    assert np.array_equal(np.sort(after.vertices[again], axis=0), np.sort(opened.vertices[rim], axis=0))


def test_pose_and_numbering_change_nothing():
    rng = np.random.default_rng(0)
    motion = random_motion(rng)
    shuffled, new = relabeled(TriMesh(apply(motion, NEEDLE.vertices), NEEDLE.faces), rng)
    (still,), (moved,) = find_spikes(NEEDLE), find_spikes(shuffled)
    assert moved.tip == new[still.tip]
    assert (moved.length, moved.width) == pytest.approx((still.length, still.width))
    before, after = remove_spikes(NEEDLE, [still])[0], remove_spikes(shuffled, [moved])[0]
    expected = apply(motion, before.vertices)
    assert np.sort(after.vertices, axis=0) == pytest.approx(np.sort(expected, axis=0), abs=1e-5)


@needs_femora
def test_a_real_femur_has_none():
    assert find_spikes(clean(femur("z046_Femur_L")).mesh) == []
