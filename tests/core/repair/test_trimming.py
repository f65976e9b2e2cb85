from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.operators import area, face_areas
from ssmpipe.core.mesh.primitives import sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold, loop_length
from ssmpipe.core.repair.trimming import cut_by_plane, height_by_width, trim
from tests.support.meshes import random_motion, relabeled

UP = np.array([0, 0, 1.0])


@pytest.mark.parametrize("height", [-7.0, 0.0, 3.3])
def test_cap_of_a_sphere(height):
    cap = trim(sphere(10.0, 5), height * UP, UP)
    assert area(cap) == pytest.approx(2 * np.pi * 10 * (10 + height), rel=2e-3)
    (loop,) = boundary_loops(cap.faces)
    assert loop_length(cap, loop) == pytest.approx(2 * np.pi * np.sqrt(100 - height**2), rel=2e-3)
    assert cap.vertices[loop, 2] == pytest.approx(np.full(len(loop), height), abs=1e-12)
    assert euler_characteristic(cap.faces) == 1
    assert is_manifold(cap.faces)


def test_cut_of_a_tube_is_exact_also_through_vertices():
    pipe = tube(1.0, 4.0, n_along=5)
    for height in (1.0, 1.7):
        kept = cut_by_plane(pipe, height * UP, UP)
        assert area(kept) == pytest.approx(area(pipe) * height / 4.0)
        assert face_areas(kept).min() > 0
        assert len(boundary_loops(kept.faces)) == 2


def test_snapping_leaves_no_slivers():
    tilted = np.array([0.1, 0.23, 1.0])
    caps = [trim(sphere(10.0, 5), np.array([0, 0, 1.234]), tilted, snap=s) for s in (0.0, 0.1)]
    loops = [boundary_loops(cap.faces)[0] for cap in caps]
    assert len(loops[1]) < 0.95 * len(loops[0])
    assert face_areas(caps[1]).min() > 20 * face_areas(caps[0]).min()


def test_trim_commutes_with_rigid_motions_and_relabeling():
    lump = star_shape()
    plane = np.array([3.0, 2.0, 5.0])
    kept = trim(lump, plane, np.array([0.2, 0.1, 1.0]))
    rng = np.random.default_rng(2)
    motion = random_motion(rng)
    shuffled, _ = relabeled(move(lump, motion), rng)
    other = trim(shuffled, apply(motion, plane[None])[0], motion[:3, :3] @ np.array([0.2, 0.1, 1.0]))
    assert area(other) == pytest.approx(area(kept), rel=1e-9)
    assert other.n_faces == kept.n_faces
    assert np.sort(other.vertices @ motion[:3, 2]) == pytest.approx(
        np.sort(kept.vertices[:, 2] + motion[:3, 3] @ motion[:3, 2])
    )


def test_refusals():
    with pytest.raises(GeometryError, match=r"the plane misses the mesh: all of it lies 2.0 mm or more behind"):
        trim(sphere(10.0), 12 * UP, UP)
    with pytest.raises(TopologyError, match=r"the plane cuts the surface in 2 curves of"):
        trim(torus(), np.zeros(3), np.array([1.0, 0, 0]))
    open_cap = trim(sphere(10.0), np.zeros(3), UP)
    with pytest.raises(TopologyError, match=r"the scan ends 2.0 mm below the trimming plane.*lower the plane by 3 mm"):
        trim(open_cap, 2 * UP, UP)


def test_width_counts_only_below_the_cut():
    lump = sphere(10.0, 4).vertices
    wide_head = np.vstack([lump, [[200.0, 0, 100.0], [-200.0, 0, 100.0]]])
    for points in (lump, wide_head):
        height, width = height_by_width(points, UP, np.array([1.0, 0, 0]), 0.75)
        assert width == pytest.approx(20.0, rel=1e-2)
        assert height == pytest.approx(-10 + 0.75 * 20, rel=3e-2)
