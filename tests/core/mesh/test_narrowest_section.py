from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.mesh.narrowest_section import narrowest_section
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.sections import section_areas
from ssmpipe.core.mesh.trimesh import TriMesh
from tests.support.meshes import aortic_root, random_motion, relabeled

POINT, NORMAL = np.array([0.5, -0.3, 8.0]), np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])


def test_no_plane_nearby_cuts_less():
    mesh = aortic_root(3.0, start=-6.0)
    found = narrowest_section(mesh, POINT, NORMAL, 40.0)
    assert found is not None

    def area(normal):
        return float(section_areas(mesh, normal, np.array([POINT @ normal]))[0][0])

    least = area(found)
    assert least < area(NORMAL)
    for across in np.linalg.svd(found[None])[2][1:]:
        for step in (0.01, -0.01):
            assert area((found + step * across) / np.hypot(1.0, step)) > least


@pytest.mark.parametrize("mirror", [False, True])
def test_motion_and_numbering_turn_it_along(mirror):
    mesh = aortic_root(3.0, start=-6.0)
    rng = np.random.default_rng(4)
    motion = random_motion(rng) @ (reflection(1) if mirror else np.eye(4))
    other, _ = relabeled(move(mesh, motion), rng)
    found = narrowest_section(mesh, POINT, NORMAL, 40.0)
    moved = narrowest_section(other, apply(motion, POINT[None])[0], motion[:3, :3] @ NORMAL, 40.0)
    assert found is not None
    assert moved == pytest.approx(motion[:3, :3] @ found, abs=1e-9)


def test_a_bulge_on_one_side_does_not_tilt_it_much():
    pipe = tube(10.0, 60.0, n_around=60, n_along=121)
    x, y, z = pipe.vertices.T
    bulge = 5.0 * np.exp(-(((z - 20.0) / 6.0) ** 2)) * np.exp(3.0 * (x / 10.0 - 1.0))
    mesh = TriMesh(np.column_stack([x + bulge * x / 10.0, y + bulge * y / 10.0, z]), pipe.faces)
    found = narrowest_section(mesh, np.array([0.0, 0.0, 6.0]), np.array([0.0, np.sin(0.1), np.cos(0.1)]), 30.0)
    assert found == pytest.approx([0, 0, 1], abs=0.02)


def test_what_is_cut_open_or_too_far_askew_is_none():
    pipe = tube(10.0, 60.0)
    up = np.array([0.0, 0.0, 1.0])
    assert narrowest_section(pipe, np.array([0.0, 0.0, -1.0]), up, 30.0) is None
    assert narrowest_section(pipe, np.array([0.0, 0.0, 0.5]), up, 30.0) is None
    assert narrowest_section(pipe, np.array([0.0, 0.0, 30.0]), np.array([0.0, np.sin(0.5), np.cos(0.5)]), 30.0) is None
