from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.primitives import sphere
from ssmpipe.core.mesh.topology import boundary_loops, genus, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import check_handles, clean
from ssmpipe.core.repair.handles import cut_handles
from ssmpipe.core.repair.trimming import cut_by_plane
from tests.support.femora import DATA, needs_vertebrae, read
from tests.support.meshes import implicit_surface, random_motion


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=1) - 20.0


def bridged(p: np.ndarray) -> np.ndarray:
    """Return a ball with a bar of 3.2 mm, bent to a half ring, on its side."""
    x, y, z = (p - [19.0, 3.0, 2.0]).T
    return np.minimum(ball(p), np.hypot(np.hypot(x, y) - 6.0, z) - 1.6)


def drilled(p: np.ndarray) -> np.ndarray:
    """Return the bridged ball with a drill hole of 4 mm beside its middle."""
    return np.maximum(bridged(p), 2.0 - np.hypot(p[:, 0] + 14.0, p[:, 1] - 1.3))


def made(function) -> TriMesh:
    return clean(implicit_surface(function, 28.0, 37)).mesh


def test_a_bridge_and_a_tunnel_leave_the_ball():
    mesh = made(drilled)
    assert genus(mesh.faces) == 2
    assert np.abs(ball(mesh.vertices)).max() > 6.0
    cut, cuts = cut_handles(mesh, 20.0)
    assert genus(cut.faces) == 0
    assert is_manifold(cut.faces)
    assert boundary_loops(cut.faces) == []
    # the drill hole leaves through the wall at a slant: a dent remains where its girth opens
    off = np.abs(ball(cut.vertices))
    assert off.max() < 1.2
    assert np.sqrt((off**2).mean()) < 0.1
    assert sorted(c.length for c in cuts) == pytest.approx([2 * np.pi * 1.6, 2 * np.pi * 2.0], rel=0.05)


def test_only_handles_that_are_short_enough_are_cut():
    mesh = made(drilled)
    cut, cuts = cut_handles(mesh, 11.0)
    assert genus(cut.faces) == 1
    assert cuts[0].place[0] > 18.0
    same, none = cut_handles(mesh, 9.0)
    assert same is mesh
    assert none == []
    with pytest.raises(TopologyError, match=r"1 handle \(genus 1\).*repair.max_handle_mm"):
        check_handles(cut)


def test_openings_and_all_that_is_far_away_stay():
    opened = cut_by_plane(made(bridged), np.array([-10.0, 0, 0]), np.array([-1.0, 0.2, 0]))
    (rim,) = boundary_loops(opened.faces)
    cut, _ = cut_handles(opened, 20.0)
    assert genus(cut.faces) == 0
    (again,) = boundary_loops(cut.faces)
    assert {tuple(p) for p in opened.vertices[rim]} == {tuple(p) for p in cut.vertices[again]}
    kept = {tuple(p) for p in cut.vertices}
    far = opened.vertices[opened.vertices[:, 0] < 10.0]
    assert all(tuple(p) in kept for p in far)


def test_a_motion_moves_the_cut():
    mesh = made(bridged)
    motion = random_motion(np.random.default_rng(0))
    _, (first,) = cut_handles(mesh, 11.0)
    _, (second,) = cut_handles(TriMesh(apply(motion, mesh.vertices), mesh.faces), 11.0)
    assert second.place == pytest.approx(apply(motion, np.array([first.place]))[0])
    assert (second.length, second.reach) == pytest.approx((first.length, first.reach))


def test_a_ball_is_returned_as_it_is():
    mesh = sphere()
    assert cut_handles(mesh, 100.0)[0] is mesh


@needs_vertebrae
def test_the_canal_of_a_vertebra_stays_for_usual_limits():
    raw = read(DATA / "vertebra_l1" / "scans" / "sub-verse010_segment_20.ply")
    mesh = clean(raw, components="largest").mesh
    same, cuts = cut_handles(mesh, 20.0)
    assert same is mesh
    assert cuts == []
