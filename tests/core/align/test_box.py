from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align import box as box_module
from ssmpipe.core.align.box import box_axes, box_frame
from ssmpipe.core.align.rigid import apply, move, rotation_angle
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from tests.support.meshes import box, joined, random_motion, relabeled


def test_a_turned_block_is_found():
    block = TriMesh(box((0.0, 0.0, 0.0)).vertices * [3.0, 7.0, 2.0], box((0.0, 0.0, 0.0)).faces)
    motion = random_motion(np.random.default_rng(1))
    frame = box_frame(move(block, motion))
    placed = apply(frame.matrix @ motion, block.vertices)
    assert np.abs(placed) == pytest.approx(np.tile([3.5, 1.5, 1.0], (8, 1)))
    assert np.linalg.det(frame.matrix[:3, :3]) == pytest.approx(1.0)


def test_no_turn_makes_the_box_smaller():
    lump = star_shape(3)
    axes = box_axes(lump)
    size = np.prod(np.ptp(lump.vertices @ axes.T, axis=0))
    rng = np.random.default_rng(0)
    others = [np.prod(np.ptp(lump.vertices @ random_motion(rng)[:3, :3], axis=0)) for _ in range(300)]
    assert size < min(others)


def test_the_search_in_two_steps_finds_the_same_box(monkeypatch):
    lump = TriMesh(
        sphere(20.0, 3).vertices * [1.0, 1.3, 1.15] + 0.2 * np.sin(sphere(20.0, 3).vertices[:, [1, 2, 0]] / 3),
        sphere(1.0, 3).faces,
    )
    monkeypatch.setattr(box_module, "LARGE", 100_000)
    whole = box_axes(lump)
    monkeypatch.setattr(box_module, "LARGE", 100)
    assert box_axes(lump) == pytest.approx(whole, abs=1e-9)


def test_motion_and_order_change_nothing():
    lump = joined(star_shape(3), box((40.0, 0.0, 0.0), 30.0))
    rng = np.random.default_rng(2)
    motion = random_motion(rng)
    other, _ = relabeled(move(lump, motion), rng)
    assert rotation_angle(box_frame(other).matrix @ motion @ np.linalg.inv(box_frame(lump).matrix)) < 1e-5
