from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.groupwise import align_group, union
from ssmpipe.core.align.rigid import move, rotation_angle
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.topology import face_components
from ssmpipe.core.mesh.trimesh import TriMesh
from tests.support.meshes import random_motion


def family(n: int) -> dict[str, TriMesh]:
    """Return lumps whose proportions and whose one long bump differ."""
    rng = np.random.default_rng(0)
    lump = star_shape(2)
    result = {}
    for k in range(n):
        high = np.clip(lump.vertices[:, 2] - 20.0, 0.0, None)
        bent = lump.vertices + np.outer(high, [*rng.normal(0.0, 0.15, 2), 0.0])
        result[f"s{k}"] = TriMesh(bent * (1.0 + 0.06 * rng.normal(size=3)), lump.faces)
    return result


def relative(poses: dict[str, np.ndarray]) -> list[np.ndarray]:
    ids = sorted(poses)
    return [np.linalg.inv(poses[ids[0]]) @ poses[i] for i in ids[1:]]


def test_the_poses_do_not_depend_on_the_first_reference():
    shapes = family(4)
    one, other = (align_group(shapes, first=first, n_points=400) for first in ("s0", "s3"))
    before = [align_group(shapes, first=first, n_points=400, max_rounds=0).value for first in ("s0", "s3")]
    apart = [
        max(rotation_angle(a @ np.linalg.inv(b)) for a, b in zip(relative(x), relative(y), strict=True))
        for x, y in ((before[0], before[1]), (one.value, other.value))
    ]
    assert apart[0] > 0.3
    assert apart[1] < 0.3 * apart[0]
    for pose in one.value.values():
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_moved_copies_fall_together():
    lump, rng = star_shape(2), np.random.default_rng(1)
    motions = {f"c{k}": random_motion(rng) for k in range(3)}
    found = align_group({i: move(lump, m) for i, m in motions.items()}, n_points=400)
    poses = [found.value[i] @ motions[i] for i in sorted(motions)]
    for pose in poses[1:]:
        assert rotation_angle(pose @ np.linalg.inv(poses[0])) < 0.3
        assert np.abs(move(lump, pose).vertices - move(lump, poses[0]).vertices).max() < 0.3


def test_the_union_holds_all_and_a_pair_is_no_group():
    balls = {"a": sphere(10.0, 4), "b": sphere(5.0, 4), "c": sphere(7.0, 3)}
    whole = union(balls, dict.fromkeys(balls, np.eye(4)))
    assert face_components(whole.faces).max() == 2
    assert area(whole) == pytest.approx(sum(map(area, balls.values())), rel=1e-9)
    with pytest.raises(GeometryError, match="a group needs three shapes, there are 2; try: align to one"):
        align_group({"a": sphere(), "b": sphere()})
