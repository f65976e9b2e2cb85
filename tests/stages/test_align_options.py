from __future__ import annotations

import logging

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages import align
from tests.support.meshes import random_motion


def go(mesh, reference, marks=None, transform=None, joins=False, **options):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"), joins=joins)
    given = np.eye(4) if transform is None else transform
    return align.run(mesh, given, reference, marks, cfg=align.Config(n_points=2000, **options), ctx=ctx), ctx


def test_unlabelled_left_and_right_are_told_apart_by_the_best_fit():
    lump, rng = star_shape(3), np.random.default_rng(3)
    for mirror in (False, True):
        given = random_motion(rng) @ (reflection(1) if mirror else np.eye(4))
        marks = Landmarks({"tip": apply(given, lump.vertices[7:8])[0]})
        outputs, ctx = go(move(lump, given), lump, marks, given, chirality="best-fit")
        assert ctx.metrics["mirrored"] is mirror
        assert ctx.metrics["other_image_cost_mm"] > 5 * ctx.metrics["cost_mm"]
        assert outputs["transform"] == pytest.approx(np.eye(4), abs=1e-2)
        assert outputs["landmarks"].points["tip"] == pytest.approx(lump.vertices[7], abs=0.1)
        assert volume(outputs["mesh"]) == pytest.approx(volume(lump))
        assert not ctx.warnings
    outputs, ctx = go(move(lump, reflection()), lump, None, chirality="best-fit")
    assert np.linalg.det(outputs["transform"]) == pytest.approx(-1.0)


def test_what_has_no_side_warns():
    given = random_motion(np.random.default_rng(2))  # turned, so that no image has the very triangles of the reference
    _, ctx = go(move(sphere(10.0, 3), given), sphere(10.2, 3), None, given, chirality="best-fit")
    assert "left and right fit almost alike" in ctx.warnings[0]
    assert "orient.mirror" in ctx.warnings[0]


def test_a_shape_that_joins_a_model_gets_advice_that_can_be_followed():
    given = random_motion(np.random.default_rng(2))
    round_ = go(move(sphere(10.0, 3), given), sphere(10.2, 3), None, given, joins=True, chirality="best-fit")[1]
    lump = star_shape(3)
    wrong = go(move(lump, reflection()), lump, joins=True)[1]
    large = go(TriMesh(10.0 * lump.vertices, lump.faces), lump, joins=True)[1]
    assert "look at its page" in round_.warnings[0]
    assert any("say --side" in warning for warning in wrong.warnings)
    told = " ".join([*round_.warnings, *wrong.warnings, *large.warnings])
    assert not [word for word in ("orient.", "align.", "cohort table", "the cohort", "report") if word in told]


def test_region_is_checked():
    with pytest.raises(ValidationError, match="region must rise"):
        align.Config(region=(0.5, 0.2))
    lump = star_shape(3)
    outputs, _ = go(lump, lump, region=(0.2, 0.9), region_axis="x")
    assert outputs["transform"] == pytest.approx(np.eye(4), abs=1e-6)


def test_strangers_are_told():
    lump = star_shape(3)
    _, ctx = go(move(lump, np.eye(4)), lump)
    assert not ctx.warnings
    large = TriMesh(10.0 * lump.vertices, lump.faces)
    _, ctx = go(large, lump)
    assert "10 times as large as the reference; check the units" in ctx.warnings[0]
    rod = TriMesh(lump.vertices * [0.2, 0.2, 3.0], lump.faces)
    _, ctx = go(rod, lump, check_mirror=False)
    assert any("does not resemble the reference" in w for w in ctx.warnings)
