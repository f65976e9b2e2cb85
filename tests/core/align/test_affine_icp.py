from __future__ import annotations

import numpy as np

from ssmpipe.core.align.affine_icp import affine_onto
from ssmpipe.core.mesh.primitives import star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from tests.support.meshes import relabeled


def test_an_affine_copy_is_reached_whatever_its_connectivity():
    lump, rng = star_shape(4), np.random.default_rng(0)
    linear = np.array([[0.7, 0.05, 0.0], [-0.03, 0.62, 0.02], [0.0, 0.06, 0.8]])
    copy = TriMesh(lump.vertices @ linear.T + [3.0, -2.0, 1.0], lump.faces)
    found = affine_onto(lump, relabeled(copy, rng)[0])
    carried = lump.vertices @ found[:3, :3].T + found[:3, 3]
    size = np.linalg.norm(np.ptp(copy.vertices, axis=0))
    assert np.linalg.norm(carried - copy.vertices, axis=1).max() < 0.005 * size


def test_a_surface_lies_on_itself():
    lump = star_shape(3)
    assert np.allclose(affine_onto(lump, lump), np.eye(4), atol=1e-9)
