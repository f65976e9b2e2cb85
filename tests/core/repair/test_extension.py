from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import sphere, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.extension import extend, trim_or_extend
from ssmpipe.core.repair.smoothing import taubin
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import random_motion

UP = np.array([0.0, 0.0, 1.0])


def rms_of(off):
    return float(np.sqrt(np.mean(np.square(off))))


def test_a_cylinder_goes_on_as_a_cylinder():
    pipe = tube(12.0, 30.0, n_around=96, n_along=60)
    loop = next(x for x in boundary_loops(pipe.faces) if pipe.vertices[x, 2].mean() > 15)
    longer = extend(pipe, loop, UP, 4.0)
    new = longer.vertices[pipe.n_vertices :]
    assert new[:, 2].max() == pytest.approx(34.0)
    assert rms_of(np.hypot(new[:, 0], new[:, 1]) - 12.0) < 0.004
    assert is_manifold(longer.faces)
    assert euler_characteristic(longer.faces) == 0
    assert volume(close_openings(longer)) == pytest.approx(np.pi * 144 * 34, rel=2e-3)


def test_a_bulge_goes_on_by_its_curvature():
    # a tube that widens like a sinus: radius 12 + 2 sin(z / 15)
    straight = tube(1.0, 30.0, n_around=96, n_along=80)
    z = straight.vertices[:, 2]
    radius = lambda z: 12.0 + 2.0 * np.sin(z / 15.0)  # noqa: E731
    mesh = TriMesh(straight.vertices * np.column_stack([radius(z), radius(z), np.ones(len(z))]), straight.faces)
    loop = next(x for x in boundary_loops(mesh.faces) if mesh.vertices[x, 2].mean() > 15)
    new = extend(mesh, loop, UP, 4.0).vertices[mesh.n_vertices :]
    off = np.hypot(new[:, 0], new[:, 1]) - radius(new[:, 2])
    assert rms_of(off) < 0.02
    straight_on = np.hypot(new[:, 0], new[:, 1]) - (radius(30.0) + (new[:, 2] - 30.0) * np.cos(2.0) / 7.5)
    assert rms_of(straight_on) > 3 * rms_of(off)


def wavy(noise: float) -> tuple[TriMesh, np.ndarray, object]:
    """Return a tube that ends in a strong bulge, its upper rim, and its radius by height."""
    straight = tube(1.0, 25.0, n_around=96, n_along=68)
    z = straight.vertices[:, 2]
    radius = lambda z: 12.0 + 2.0 * np.sin(z / 10.0)  # noqa: E731
    mesh = TriMesh(straight.vertices * np.column_stack([radius(z), radius(z), np.ones(len(z))]), straight.faces)
    rough = np.random.default_rng(0).normal(size=mesh.vertices.shape) * [noise, noise, 0.0]
    mesh = taubin(TriMesh(mesh.vertices + rough, mesh.faces)) if noise else mesh
    return mesh, next(x for x in boundary_loops(mesh.faces) if mesh.vertices[x, 2].mean() > 15), radius


def test_the_change_of_curvature_is_continued_where_there_is_no_noise():
    mesh, loop, radius = wavy(0.0)
    new = extend(mesh, loop, UP, 4.0).vertices[mesh.n_vertices :]
    assert rms_of(np.hypot(new[:, 0], new[:, 1]) - radius(new[:, 2])) < 0.01  # 0.041 with quadratics
    mesh, loop, radius = wavy(0.1)
    new = extend(mesh, loop, UP, 4.0).vertices[mesh.n_vertices :]
    assert rms_of(np.hypot(new[:, 0], new[:, 1]) - radius(new[:, 2])) < 0.2  # 0.48 with cubics


def test_a_cap_is_continued_to_the_plane_and_no_farther_than_allowed():
    cap = trim(sphere(20.0, 5), 5.0 * UP, UP)
    motion = random_motion(np.random.default_rng(0))
    turned, up = move(cap, motion), motion[:3, :3] @ UP
    point = apply(motion, 8.0 * UP[None])[0]
    longer, added = trim_or_extend(turned, point, up, extend_mm=4.0)
    assert added == pytest.approx(3.0)
    (loop,) = boundary_loops(longer.faces)
    assert (longer.vertices[loop] - point) @ up == pytest.approx(np.zeros(len(loop)), abs=1e-9)
    back = apply(np.linalg.inv(motion), longer.vertices)
    assert rms_of(np.linalg.norm(back[back[:, 2] > 5.1], axis=1) - 20.0) < 0.02
    with pytest.raises(TopologyError, match=r"the scan ends 3\.0 mm below the trimming plane"):
        trim_or_extend(turned, point, up, extend_mm=2.0)
    assert trim_or_extend(turned, apply(motion, 2.0 * UP[None])[0], up, extend_mm=4.0)[1] == 0.0


def test_a_short_surface_cannot_be_continued():
    ring = tube(12.0, 2.0, n_around=48, n_along=5)
    with pytest.raises(TopologyError, match=r"the surface ends 2\.0 mm inside its rim, 6 mm are needed"):
        extend(
            ring,
            boundary_loops(ring.faces)[0],
            UP if ring.vertices[boundary_loops(ring.faces)[0], 2].mean() > 1 else -UP,
            4.0,
        )
