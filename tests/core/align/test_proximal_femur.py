from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.proximal_femur import analyze_proximal_femur, femur_proximal_frame
from ssmpipe.core.align.rigid import apply, move, reflection, rotation_angle
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.primitives import sphere, star_shape, tube
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.trimming import trim
from ssmpipe.synth import femur_proximal as fp
from ssmpipe.synth.implicit import polygonize, project
from tests.support.femora import femur, femur_ids, landmark, needs_femora, sides
from tests.support.meshes import random_motion, relabeled


def upper_part(shape_id, below):
    """Return the part of a bone above the plane ``below`` mm under its lesser trochanter, across the shaft."""
    bone = femur(shape_id)
    found = analyze_proximal_femur(bone)
    return trim(bone, landmark(shape_id, "LT") - below * found.axis, -found.axis), found


@needs_femora
@pytest.mark.slow
def test_trochanter_of_whole_bones_and_upper_parts_against_the_raters():
    off = []
    for shape_id in femur_ids():
        mark = landmark(shape_id, "LT")
        part, whole = upper_part(shape_id, 60.0)
        for found in (whole, analyze_proximal_femur(part)):
            off.append(float((found.trochanter - mark) @ whole.axis))
            assert np.linalg.norm(found.trochanter - mark) < 6.0
            assert found.bulge > 4.0
            assert np.linalg.norm(landmark(shape_id, "MFH") - found.head) == pytest.approx(found.head_radius, rel=0.1)
    assert np.sqrt(np.mean(np.square(off))) < 2.2
    assert np.abs(off).max() < 4.0


@needs_femora
def test_frame_of_left_and_right_whole_and_part():
    for shape_id in ("z013_Femur_L", "z035_Femur_R"):
        mirror = reflection(0) if sides()[shape_id] == "L" else np.eye(4)
        part, whole = upper_part(shape_id, 60.0)
        frame = femur_proximal_frame(move(part, mirror)).matrix @ mirror
        head, trochanter, greater = (apply(frame, landmark(shape_id, c)[None])[0] for c in ("MFH", "LT", "SGT"))
        assert head[0] < -30.0
        assert trochanter[1] < -5.0  # behind
        assert greater[0] > 0.0
        assert -90.0 < trochanter[2] < -25.0
        assert frame[2, :3] @ whole.axis > np.cos(np.radians(4.0))


@needs_femora
def test_motion_order_and_mirror_change_nothing():
    part, _ = upper_part("z024_Femur_R", 70.0)
    found = analyze_proximal_femur(part)
    rng = np.random.default_rng(5)
    motion = random_motion(rng)
    other, _ = relabeled(move(part, motion), rng)
    again = analyze_proximal_femur(other)
    assert again.trochanter == pytest.approx(apply(motion, found.trochanter[None])[0], abs=1e-6)
    assert again.axis == pytest.approx(motion[:3, :3] @ found.axis, abs=1e-9)
    flipped = analyze_proximal_femur(move(part, motion @ reflection(1)))
    assert flipped.head == pytest.approx(apply(motion @ reflection(1), found.head[None])[0], abs=1e-6)
    assert flipped.trochanter == pytest.approx(apply(motion @ reflection(1), found.trochanter[None])[0], abs=1e-6)
    turned = femur_proximal_frame(other).matrix @ motion @ np.linalg.inv(femur_proximal_frame(part).matrix)
    assert rotation_angle(turned) < 1e-5


@pytest.mark.parametrize("mesh", [sphere(20.0, 3), close_openings(tube(10.0, 200.0)), star_shape(3)])
def test_what_is_no_femur_is_refused(mesh: TriMesh):
    with pytest.raises(GeometryError, match=r"no (femoral head|lesser trochanter|shaft) found.*try: "):
        analyze_proximal_femur(mesh)


@pytest.fixture(scope="module")
def template() -> TriMesh:
    """Return the synthetic right femur with a long shaft, lesser trochanter at height 0."""
    lower = np.array([*fp._LOWER[:2], -205.0])
    vertices, faces = polygonize(
        lambda p: np.maximum(fp.template_field(p), -(p[:, 2] + 200.0)), lower, fp._UPPER, 4.0, np.eye(4)
    )
    return TriMesh(project(fp.template_field, vertices, n_steps=1), faces)


@pytest.mark.parametrize("closed", [False, True], ids=["open", "flat end"])
@pytest.mark.parametrize("shaft", [-36.0, -75.0, -195.0])
@pytest.mark.parametrize("neck", [(0.0, 0.0, 0.0), (3.0, -3.0, -1.9), (-2.0, 2.0, 1.5)], ids=["mean", "steep", "flat"])
def test_shafts_of_every_length_and_odd_necks(template: TriMesh, shaft: float, neck: tuple[float, ...], closed: bool):
    """Neck angle, anteversion and lesser trochanter beyond what the cohort has; pieces 1.5 to 4 times longer than wide."""
    scores = np.zeros(len(fp.MODES))
    scores[[1, 2, 7]] = neck
    part = trim(template, np.array([0.0, 0.0, shaft]), np.array([0.03, -0.02, -1.0]) / np.linalg.norm([0.03, -0.02, 1]))
    part = close_openings(part) if closed else part
    places = np.array([fp.HEAD, [-13.0, -17.0, 0.0], [0.0, 0.0, -30.0], [0.0, 0.0, -10.0]])
    head, trochanter, low, high = fp.deform(places, scores, fp.Cam(0.0))
    motion = random_motion(np.random.default_rng(int(-shaft)))
    bone = TriMesh(fp.deform(part.vertices, scores, fp.Cam(0.0)), part.faces)
    found = analyze_proximal_femur(move(bone, motion))
    axis = motion[:3, :3] @ (high - low) / np.linalg.norm(high - low)
    assert np.degrees(np.arccos(found.axis @ axis)) < 4.0
    assert np.linalg.norm(found.head - apply(motion, head[None])[0]) < 2.0
    assert abs((found.trochanter - apply(motion, trochanter[None])[0]) @ axis) < 6.0
