from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from ssmpipe.core.align.frames import femur_distal_frame, landmark_frame, principal_frame
from ssmpipe.core.align.rigid import apply, move, reflection, rotation_angle
from ssmpipe.core.errors import GeometryError, LandmarkError
from ssmpipe.core.mesh.primitives import sphere, star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.trimming import trim
from tests.support.femora import femur, femur_ids, landmark, needs_femora, sides
from tests.support.meshes import noisy, random_motion, relabeled


def right_side(shape_id: str) -> np.ndarray:
    return reflection(0) if sides()[shape_id] == "L" else np.eye(4)


def test_principal_frame_turns_with_the_shape():
    lump, rng = star_shape(3), np.random.default_rng(0)
    motion = random_motion(rng)
    frame = principal_frame(lump)
    moved = principal_frame(relabeled(move(lump, motion), rng)[0])
    assert moved.matrix @ motion == pytest.approx(frame.matrix, abs=1e-8)
    spread = np.ptp(apply(frame.matrix, lump.vertices), axis=0)
    assert spread[0] > spread[1] > spread[2]


def test_landmark_frame_refuses_points_on_a_line():
    with pytest.raises(LandmarkError, match=r"one line"):
        landmark_frame(np.array([0, 0, 1.0]), np.zeros(3), np.array([0, 0, 5.0]))


def test_a_ball_is_not_a_femur():
    with pytest.raises(GeometryError, match=r"1\.00 condylar widths high"):
        femur_distal_frame(sphere(40.0))
    with pytest.raises(GeometryError, match=r"no distal femur recognized: the straight side over the fossa is 0"):
        femur_distal_frame(TriMesh(sphere(40.0).vertices * [1.0, 0.8, 3.0], sphere().faces))


def test_a_tapering_lump_is_not_a_femur():
    angle = np.linspace(0, np.pi, 20)
    base = 40 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    points = np.vstack([base, 0.05 * base + [0, 0, 180.0]])
    hull = ConvexHull(points)
    outward = (
        np.einsum(
            "ij,ij->i",
            np.cross(*(points[hull.simplices[:, k]] - points[hull.simplices[:, 0]] for k in (1, 2))),
            hull.equations[:, :3],
        )
        > 0
    )
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    with pytest.raises(GeometryError, match=r"its largest section is \d+\.\d times its smallest"):
        femur_distal_frame(TriMesh(points, faces))


@needs_femora
def test_frames_of_real_femora_agree_with_their_landmarks():
    for shape_id in femur_ids():
        side = right_side(shape_id)
        bone = move(femur(shape_id), side)
        frame = femur_distal_frame(bone)
        at = {
            code: apply(frame.matrix @ side, landmark(shape_id, code)[None])[0]
            for code in ("LEC", "MEC", "PLC", "PMC", "SFH", "DMC", "DLC")
        }
        assert np.linalg.det(frame.matrix[:3, :3]) == pytest.approx(1.0)
        posterior_line = at["PLC"] - at["PMC"]
        assert np.degrees(np.arctan2(abs(posterior_line[1]), posterior_line[0])) < 1.5
        epicondyles = at["LEC"] - at["MEC"]
        assert np.degrees(np.arctan2(abs(epicondyles[1]), epicondyles[0])) < 10
        assert at["PLC"][1] < at["LEC"][1]
        # the mechanical axis leans 2 to 9 degrees against the shaft
        mechanical = at["SFH"] - 0.5 * (at["LEC"] + at["MEC"])
        assert 2 < np.degrees(np.arccos(mechanical[2] / np.linalg.norm(mechanical))) < 9
        assert -2 < at["DMC"][2] < 10
        assert frame.overhang > 0.3
        assert 0.4 < frame.tangent < 0.8


@needs_femora
@pytest.mark.parametrize(("height", "tolerance_deg"), [(3.0, 0.2), (1.6, 0.5), (1.3, 3.0)])
def test_a_stump_in_any_pose_gets_the_frame_of_the_whole_bone(height, tolerance_deg):
    rng = np.random.default_rng(int(10 * height))
    for shape_id in femur_ids()[::5]:
        bone = move(femur(shape_id), right_side(shape_id))
        frame = femur_distal_frame(bone)
        inverse = np.linalg.inv(frame.matrix)
        top = apply(inverse, np.array([[0, 0, height * frame.width]]))[0]
        piece = trim(bone, top, inverse[:3, 2])
        for stump in (piece, close_openings(piece), noisy(piece, rng, 0.1)):
            motion = random_motion(rng)
            again = femur_distal_frame(move(stump, motion))
            rest = again.matrix @ motion @ inverse
            assert rotation_angle(rest) < tolerance_deg
            assert np.linalg.norm(rest[:3, 3]) < 2.0
            assert again.width == pytest.approx(frame.width, rel=0.02)
