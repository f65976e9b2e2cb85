from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import (
    apply,
    axis_rotations,
    homogeneous,
    move,
    reflection,
    rigid_fit,
    rotation_angle,
    rotation_vector_matrix,
)
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import star_shape
from tests.support.meshes import random_motion


def test_fit_recovers_a_motion_and_never_reflects():
    rng = np.random.default_rng(0)
    points, motion = rng.normal(size=(20, 3)), random_motion(rng)
    assert rigid_fit(points, apply(motion, points)) == pytest.approx(motion)
    mirrored = rigid_fit(points, apply(reflection(), points))
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1.0)


def test_mirroring_turns_faces_and_commutes_with_motions():
    lump = star_shape(2)
    assert volume(move(lump, reflection(1))) == pytest.approx(volume(lump))
    motion = random_motion(np.random.default_rng(1))
    twice = move(move(lump, reflection()), motion)
    at_once = move(lump, motion @ reflection())
    assert twice.vertices == pytest.approx(at_once.vertices)
    assert np.array_equal(twice.faces, at_once.faces)


def test_rotations():
    assert rotation_angle(rotation_vector_matrix(np.array([0, 0, 1e-9]))) == pytest.approx(np.degrees(1e-9))
    assert rotation_angle(rotation_vector_matrix(np.array([1.0, 2.0, -0.5]))) == pytest.approx(
        np.degrees(np.sqrt(5.25))
    )
    all_24 = axis_rotations()
    assert len(np.unique(all_24.reshape(24, 9), axis=0)) == 24
    assert np.linalg.det(all_24) == pytest.approx(np.ones(24))
    assert np.array_equal(all_24[0], np.eye(3))
    assert homogeneous(np.eye(3), np.ones(3))[:3, 3] == pytest.approx(1.0)
