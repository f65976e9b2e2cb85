"""The synthetic proximal femora: bones, groups and flaws as promised, and the truth about them is true."""

from __future__ import annotations

import json
from pathlib import Path

import igl
import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.core.errors import ConfigError
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.tables import read_cohort
from ssmpipe.synth import femur_proximal as fp
from ssmpipe.synth._scans import apply
from ssmpipe.synth.implicit import field_gradient

N = 5


@pytest.fixture(scope="module")
def cohort(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hips")
    fp.write_cohort(folder, n=N, seed=2, groups=True, spacing=2.8)
    return folder


@pytest.fixture(scope="module")
def truth(cohort: Path) -> dict[str, np.ndarray]:
    return dict(np.load(cohort / "truth.npz"))


@pytest.fixture(scope="module")
def template() -> tuple[np.ndarray, np.ndarray]:
    return fp.template_mesh()


def bone(faces: np.ndarray) -> np.ndarray:
    """Return the faces of the largest component that are triangles, not lines or points."""
    _, label = igl.facet_components(faces)
    faces = faces[label == np.bincount(label).argmax()]
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def test_template_lies_on_its_field_and_is_one_disk(template: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = template
    assert np.abs(fp.template_field(vertices)).max() < 1e-6
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(vertices) - len(edges) + len(faces) == 1
    normals = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    outward = field_gradient(fp.template_field, vertices[faces].mean(axis=1))
    assert ((normals * outward).sum(axis=1) > 0).mean() > 0.998


def test_template_has_the_proportions_of_a_proximal_femur(template: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, _ = template
    marks = fp.template_landmarks(vertices)
    head = vertices[np.linalg.norm(vertices - fp.HEAD, axis=1) < 1.02 * fp.HEAD_RADIUS]
    assert np.percentile(np.linalg.norm(head - fp.HEAD, axis=1), 90) == pytest.approx(fp.HEAD_RADIUS, abs=0.2)
    angle = np.degrees(np.arccos(fp.NECK @ [0.0, 0.0, -1.0]))
    assert 120 < angle < 142  # between neck and shaft
    assert 5 < fp.HEAD[1] < 12  # the neck points forwards
    assert np.linalg.norm(marks["SNI"] - marks["INI"]) < 1.7 * fp.HEAD_RADIUS  # narrower than the head
    assert np.linalg.norm(marks["ANI"] - marks["PNI"]) < 1.6 * fp.HEAD_RADIUS
    assert marks["SGT"][0] > 15
    assert marks["SFH"][2] > marks["SGT"][2] + 15
    assert marks["LT"][0] < -10  # medial ...
    assert marks["LT"][1] < -15  # ... and posterior
    assert marks["FOVEA"][0] < fp.HEAD[0] - 18
    assert np.linalg.norm(marks["FOVEA"] - fp.HEAD) < fp.HEAD_RADIUS - 2  # a dimple
    assert marks["IFH"][2] < fp.HEAD[2] - 20
    assert marks["CAM"][2] > marks["ANI"][2]
    assert marks["CAM"][1] > marks["SNI"][1]
    for point in marks.values():
        assert abs(fp.template_field(point[None])[0]) < 1e-6


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("mode", range(9))
def test_deformation_is_one_to_one(mode: int, sign: int) -> None:
    rng = np.random.default_rng(mode)
    points = rng.uniform([-60, -30, -80], [36, 36, 95], size=(4000, 3))
    points = points[fp.template_field(points) < 3.0]
    own = fp.own_field(rng)
    scores = np.full(9, sign * 0.8)
    scores[mode] = sign * 3.0
    cam = fp.Cam(5.5)
    jacobian = np.stack(
        [
            (fp.deform(points + e, scores, cam, own) - fp.deform(points - e, scores, cam, own)) / 2e-4
            for e in 1e-4 * np.eye(3)
        ],
        axis=-1,
    )
    assert np.linalg.det(jacobian).min() > 0.1


def test_far_down_the_shaft_a_flat_cut_stays_flat() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-16, 16, (200, 2)), np.full(200, -60.0)])
    moved = fp.deform(plane, rng.normal(size=9), fp.Cam(4.0), fp.own_field(rng))
    singular = np.linalg.svd(moved - moved.mean(axis=0), compute_uv=False)
    assert singular[2] < 0.02


def test_cam_has_the_stated_height_and_place(template: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, _ = template
    cam = fp.Cam(4.0, 45.0)
    moved = np.linalg.norm(cam.displacement(vertices), axis=1)
    assert moved.max() == pytest.approx(4.0, abs=0.2)
    assert np.linalg.norm(vertices[moved.argmax()] - cam.place) < 2.5
    assert abs(fp.template_field(cam.place[None])[0]) < 1e-6
    assert 10 < (cam.place - fp.HEAD) @ -fp.NECK < 20  # where the head meets the neck
    assert np.array_equal(fp.Cam(0.0).displacement(vertices), np.zeros_like(vertices))
    superior, anterior = fp.Cam(1.0, 0.0).place, fp.Cam(1.0, 90.0).place
    assert superior[2] > anterior[2] + 8
    assert anterior[1] > superior[1] + 8
    slope = field_gradient(fp.template_field, cam.place[None])[0]
    assert slope @ cam.direction > 0.7 * np.linalg.norm(slope)  # outwards


def test_groups_follow_the_table() -> None:
    bones = fp.grouped_bones(29, 0)
    sick = np.array([b.cam.height > 0 for b in bones])
    assert (sick.sum(), (~sick).sum()) == (16, 13)
    subjects = np.array([b.subject for b in bones])
    assert np.bincount(subjects).tolist() == [2] * 12 + [1] * 5
    for subject in range(12):
        pair = [b for b in bones if b.subject == subject]
        assert pair[0].left != pair[1].left
        assert (pair[0].cam.height > 0) != (pair[1].cam.height > 0)
    assert 9 < sum(b.left for b in bones) < 20
    heights = [b.cam.height for b in bones if b.cam.height > 0]
    assert (min(heights), max(heights)) == (2.5, 5.5)
    scores = np.array([b.scores for b in bones])
    within = np.std(scores[0:24:2] - scores[1:24:2], axis=0).mean()
    assert within < 0.5 * np.std(scores[0:24:2], axis=0).mean()
    assert {b.subject: b.outlier for b in bones if b.outlier} == {2: "size", 5: "shape"}
    assert np.abs(scores[[b.outlier == "size" for b in bones], 0]).min() > 3


def test_without_groups_all_are_healthy() -> None:
    bones = fp.healthy_bones(6, 0)
    assert [b.left for b in bones] == [False, True] * 3
    assert len({b.subject for b in bones}) == 6
    assert not any(b.cam.height or b.outlier for b in bones)


def test_scans_are_closed_and_the_truth_lies_on_them(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    about = json.loads((cohort / "truth.json").read_text())
    counts = set()
    for i, shape_id in enumerate(truth["ids"]):
        mesh = read_mesh(cohort / "scans" / f"{shape_id}.stl")
        faces = bone(mesh.faces)
        counts.add(len(faces))
        assert 4000 < len(faces) < 20000
        assert len(np.unique(faces)) - len(faces) / 2 == 2  # a closed surface without handles
        assert igl.boundary_loop(faces).size == 0
        corners = mesh.vertices[faces] - mesh.vertices[faces[0, 0]]
        assert np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
        n_parts = igl.facet_components(mesh.faces)[0]
        assert n_parts == (7 if shape_id in about["debris"] else 1)  # two specks, four stray triangles
        distance = np.sqrt(igl.point_mesh_squared_distance(truth["points"][i], mesh.vertices, faces)[0])
        covered = truth["covered"][i]
        assert np.sqrt((distance[covered] ** 2).mean()) < 0.2
        if shape_id in about["platform"]:
            assert 3 < distance.max() < 6
            assert 0.9 < covered.mean() < 0.99
        else:
            assert covered.all()
    assert len(counts) == N  # own connectivity each


def test_platform_is_flat_and_on_top_of_the_head(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    assert json.loads((cohort / "truth.json").read_text())["platform"] == ["hip_01"]
    missing = truth["template"][~truth["covered"][0]]
    assert missing[:, 2].min() > fp.HEAD[2] + 10
    mesh = read_mesh(cohort / "scans" / "hip_01.stl")
    squared, _, foot = igl.point_mesh_squared_distance(truth["points"][0], mesh.vertices, mesh.faces)
    platform = foot[squared > 2.0**2]
    assert len(platform) > 20
    spread = np.linalg.svd(platform - platform.mean(axis=0), compute_uv=False) / np.sqrt(len(platform))
    assert spread[1] > 3
    assert spread[2] < 0.25


def test_shafts_end_at_different_heights(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    cuts = list(json.loads((cohort / "truth.json").read_text())["shaft_cut_mm"].values())
    for i, shape_id in enumerate(truth["ids"]):
        local = apply(np.linalg.inv(truth["pose"][i]), read_mesh(cohort / "scans" / f"{shape_id}.stl").vertices)
        size = 1 + 0.04 * truth["scores"][i, 0]
        assert np.percentile(local[:, 2], 1) / size == pytest.approx(cuts[i], abs=2.0)
    assert np.ptp(cuts) > 15
    assert max(cuts) < fp.TRUTH_BOTTOM - 10


def test_tables_agree_with_the_truth(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    table = read_cohort(cohort / "cohort.csv")
    marks = read_landmarks(cohort / "landmarks.json")
    assert list(table) == list(marks) == truth["ids"].tolist()
    assert {row["side"] for row in table.values()} == {"L", "R"}
    assert len({row["subject"] for row in table.values()}) < N
    for i, (row, named) in enumerate(zip(table.values(), marks.values(), strict=True)):
        assert (np.linalg.det(truth["pose"][i][:3, :3]) < 0) == (row["side"] == "L")
        assert (row["group"] == "cam") == (truth["cam_height"][i] > 0)
        assert tuple(named) == fp.LANDMARKS == tuple(truth["landmark_names"])
        places = np.array(list(named.values()))
        assert np.abs(places - truth["landmarks"][i]).max() < 1e-3
        distance = np.sqrt(igl.point_mesh_squared_distance(places, truth["points"][i], truth["faces"])[0])
        assert distance.max() < 0.6  # the chords of the truth's triangles


def test_truth_follows_its_formula(truth: dict[str, np.ndarray]) -> None:
    """Pose undone, size undone, modes and cam taken off: only the small field of its own is left."""
    for i, (pose, scores, points) in enumerate(zip(truth["pose"], truth["scores"], truth["points"], strict=True)):
        canonical = apply(np.linalg.inv(pose), points) / (1 + 0.04 * scores[0])
        rest = canonical - truth["template"] - np.tensordot(scores[1:], truth["modes"][1:], axes=1)
        cam = fp.Cam(float(truth["cam_height"][i]), float(truth["cam_angle"][i])).displacement(truth["template"])
        assert np.allclose(np.linalg.norm(cam, axis=1), truth["cam"][i])
        assert 0.1 < np.sqrt(((rest - cam) ** 2).sum(axis=1).mean()) < 1.0


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        fp.write_cohort(tmp_path / name, n=3, seed=5, groups=True, spacing=4.0)
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(files) == 3 + 4
    assert all((tmp_path / "one" / f).read_bytes() == (tmp_path / "two" / f).read_bytes() for f in files)


def test_two_shapes_are_no_cohort(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at least 3 shapes, got 2"):
        fp.write_cohort(tmp_path, n=2)


def test_groups_is_a_switch_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def write_cohort(out_dir: Path, **options: object) -> None:
        (out_dir / "scans").mkdir(parents=True)
        asked.append(options)

    monkeypatch.setattr(fp, "write_cohort", write_cohort)
    for name, switches in (("a", ["--groups"]), ("b", ["--n", "4"])):
        result = CliRunner().invoke(main, ["synth", "femur-proximal", str(tmp_path / name), *switches])
        assert result.exit_code == 0, result.output
    assert asked == [{"seed": 0, "groups": True}, {"n": 4, "seed": 0, "groups": False}]
