from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import move
from ssmpipe.core.mesh.operators import mean_edge_length, volume
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, tube
from ssmpipe.core.mesh.topology import boundary_half_edges
from ssmpipe.core.repair.fairing import fair
from ssmpipe.core.repair.smoothing import taubin
from tests.support.meshes import noisy, random_motion, relabeled


@pytest.mark.parametrize(("order", "power"), [("flow", 2), ("bilaplacian", 4)])
def test_a_wave_is_damped_by_the_stated_factor(order, power):
    flat = flat_square(61, 60.0)
    x = flat.vertices[:, 0]
    wave = 12.0  # divides the side, so that the rim at x = 0 and 60 stays at rest
    rough = type(flat)(flat.vertices + np.outer(1e-3 * np.sin(2 * np.pi * x / wave), [0, 0, 1.0]), flat.faces)
    cutoff = 10.0
    after = fair(rough, order=order, cutoff=cutoff)
    inner = np.abs(flat.vertices - 30.0)[:, :2].max(axis=1) < 12
    ratio = np.linalg.norm(after.vertices[inner, 2]) / np.linalg.norm(rough.vertices[inner, 2])
    expected = 1 / (1 + (cutoff * mean_edge_length(flat) / wave) ** power)
    assert ratio == pytest.approx(expected, rel=0.05)


def test_bilaplacian_keeps_the_volume_better_than_flow():
    ball = sphere(30.0, 4)
    rough = noisy(ball, np.random.default_rng(0), 0.2)
    changes = {}
    for order in ("flow", "bilaplacian"):
        smooth = fair(rough, order=order, cutoff=8.0)
        changes[order] = abs(volume(smooth) / volume(ball) - 1)
        assert np.std(np.linalg.norm(smooth.vertices, axis=1)) < 0.1
    assert changes["bilaplacian"] < 0.002 < changes["flow"]


def test_the_rim_stays_or_follows():
    pipe = noisy(tube(10.0, 30.0), np.random.default_rng(1), 0.2)
    rim = np.unique(boundary_half_edges(pipe.faces))
    assert np.array_equal(fair(pipe, order="bilaplacian", cutoff=6.0).vertices[rim], pipe.vertices[rim])
    assert np.array_equal(taubin(pipe, fix_boundary=True).vertices[rim], pipe.vertices[rim])
    goal = taubin(pipe).vertices
    followed = fair(pipe, order="bilaplacian", cutoff=6.0, rim=goal)
    assert followed.vertices[rim] == pytest.approx(goal[rim])


def test_motion_and_order_change_nothing():
    lump, rng = star_shape(3), np.random.default_rng(2)
    motion = random_motion(rng)
    shuffled, new = relabeled(lump, rng)
    expected = fair(lump, order="bilaplacian", cutoff=6.0)
    assert fair(move(lump, motion), order="bilaplacian", cutoff=6.0).vertices == pytest.approx(
        move(expected, motion).vertices, abs=1e-7
    )
    assert fair(shuffled, order="bilaplacian", cutoff=6.0).vertices[new] == pytest.approx(expected.vertices, abs=1e-7)
