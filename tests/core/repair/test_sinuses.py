from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.primitives import tube
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.repair.sinuses import find_sinuses, planes_at_sinuses, sinus_valleys
from ssmpipe.core.repair.tube_ends import openings
from tests.support.meshes import aortic_root, random_motion, relabeled

MIDDLE, HALF = 12.0, 7.0
"""Where the wave of the lobes is largest, and how far from there it has half its size [mm]."""


def rims(mesh):
    return openings(mesh, [None, None])


@pytest.mark.parametrize(("size", "start", "width"), [(3.0, -6.0, 14.0), (1.2, -3.0, 11.0), (4.0, 2.0, 16.0)])
def test_the_ends_of_the_lobes_are_found_whatever_their_size(size, start, width):
    mesh = aortic_root(size, start, width=width)
    found = find_sinuses(mesh, rims(mesh))
    assert len(boundary_loops(mesh.faces)) == 2
    assert found.height == pytest.approx(2 * HALF, abs=0.7)
    lower, upper = planes_at_sinuses(mesh, found, 0.35, 50.0)
    assert lower.point == pytest.approx([0, 0, MIDDLE - 1.7 * HALF], abs=0.6)
    assert upper is not None
    assert (upper.point - lower.point)[2] == pytest.approx(50.0, abs=0.2)
    assert lower.normal == pytest.approx([0, 0, -1], abs=0.03)
    assert upper.normal == pytest.approx([0, 0, 1], abs=0.03)
    assert planes_at_sinuses(mesh, found, 0.35, None)[1] is None


def test_a_scan_that_starts_inside_the_sinuses_is_continued_by_symmetry():
    mesh = aortic_root(3.0, start=MIDDLE - 5.0)
    lower, _ = planes_at_sinuses(mesh, find_sinuses(mesh, rims(mesh)), 0.0, None)
    assert lower.point[2] == pytest.approx(MIDDLE - HALF, abs=1.2)


def test_motion_and_order_move_the_planes_along():
    mesh = aortic_root(2.5)
    rng = np.random.default_rng(3)
    motion = random_motion(rng)
    other, _ = relabeled(move(mesh, motion), rng)
    for one, two in zip(
        planes_at_sinuses(mesh, find_sinuses(mesh, rims(mesh)), 0.35, 40.0),
        planes_at_sinuses(other, find_sinuses(other, rims(other)), 0.35, 40.0),
        strict=True,
    ):
        assert one is not None
        assert two is not None
        assert two.point == pytest.approx(apply(motion, one.point[None])[0], abs=1e-6)
        assert two.normal == pytest.approx(motion[:3, :3] @ one.normal, abs=1e-8)


@pytest.mark.parametrize(
    ("mesh", "words"),
    [(tube(12.0, 60.0), "does not widen"), (aortic_root(3.0, waves=2), "no three lobes")],
    ids=["plain", "oval"],
)
def test_what_has_no_sinuses_is_told(mesh, words):
    with pytest.raises(GeometryError, match=f"no sinuses were found: .*{words}"):
        find_sinuses(mesh, rims(mesh))


def test_valleys_lie_between_the_sinuses_wherever_the_scan_lies():
    motion = random_motion(np.random.default_rng(5))
    for mesh, back in ((aortic_root(2.5), np.eye(4)), (move(aortic_root(2.5), motion), np.linalg.inv(motion))):
        valleys = apply(back, sinus_valleys(mesh, find_sinuses(mesh, rims(mesh))))
        angles = np.sort(np.degrees(np.arctan2(valleys[:, 1], valleys[:, 0])) % 360.0)
        assert angles == pytest.approx([60.0, 180.0, 300.0], abs=3.0)
        assert valleys[:, 2] == pytest.approx(MIDDLE, abs=1.0)
