"""The synthetic femora: closed, anatomical, and the truth about them is true."""

from __future__ import annotations

import json
from pathlib import Path

import igl
import numpy as np
import pytest

from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.tables import read_cohort
from ssmpipe.synth import femur_distal as fd
from ssmpipe.synth.implicit import field_gradient

N = 4
COMMITTED = Path(__file__).parents[2] / "data_synthetic" / "femur_distal"


@pytest.fixture(scope="module")
def cohort(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cohort")
    fd.write_cohort(folder, n=N, seed=5, spacing=3.2)
    return folder


@pytest.fixture(scope="module")
def template() -> tuple[np.ndarray, np.ndarray]:
    return fd.template_mesh()


def bone(mesh: TriMesh) -> np.ndarray:
    """Return the faces of the largest component."""
    _, label = igl.facet_components(mesh.faces)
    return mesh.faces[label == np.bincount(label).argmax()]


def test_template_lies_on_its_field_and_is_one_disk(template: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = template
    assert np.abs(fd.template_field(vertices)).max() < 1e-6
    assert 1500 < len(vertices) < 3000
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(vertices) - len(edges) + len(faces) == 1
    normals = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    outward = field_gradient(fd.template_field, vertices[faces].mean(axis=1))
    assert ((normals * outward).sum(axis=1) > 0).mean() > 0.999


def test_template_has_the_proportions_of_a_femur() -> None:
    vertices, _ = fd.template_mesh(2.0)
    width, depth, _ = np.ptp(vertices[vertices[:, 2] < 50], axis=0)
    assert 76 < width < 86
    assert 55 < depth < 66
    marks = fd.template_landmarks(vertices)
    assert marks["DMC"][2] < marks["DLC"][2] < marks["ICN"][2]  # the medial condyle reaches further down
    top = vertices[np.abs(vertices[:, 2] - 90) < 8]
    assert abs(np.ptp(top[:, 1]) - 30) < 4
    axis = (top[:, 1].min() + top[:, 1].max()) / 2
    assert axis - vertices[:, 1].min() > 1.4 * (vertices[:, 1].max() - axis)  # condyles overhang posteriorly
    low = vertices[vertices[:, 2] < 40]
    anterior = [low[np.abs(low[:, 0] - x) < 2, 1].max() for x in (17.0, 1.0, -14.0)]
    assert anterior[0] > anterior[2] > anterior[1] + 1.5  # lateral ridge, medial ridge, groove between
    behind = vertices[(np.abs(vertices[:, 0]) < 5) & (vertices[:, 2] < 18)]
    assert behind[:, 1].min() > marks["PLC"][1] + 20  # the notch is open at the back


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("mode", range(5))
def test_deformation_is_one_to_one(mode: int, sign: int) -> None:
    rng = np.random.default_rng(mode)
    points = rng.uniform([-48, -42, -8], [48, 34, 160], size=(4000, 3))
    own = fd.own_field(rng)
    scores = np.full(5, sign * 1.0)
    scores[mode] = sign * 2.2
    step = 1e-4
    jacobian = np.stack(
        [
            (fd.deform(points + e, scores, own) - fd.deform(points - e, scores, own)) / (2 * step)
            for e in step * np.eye(3)
        ],
        axis=-1,
    )
    assert np.linalg.det(jacobian).min() > 0.1


def test_modes_move_points_along_the_surface(template: tuple[np.ndarray, np.ndarray]) -> None:
    """The slide mode is mostly tangential: it changes arc length far more than shape."""
    vertices, _ = template
    normals = field_gradient(fd.template_field, vertices)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    slide = fd.mode_fields(vertices)[4]
    normal_part = (slide * normals).sum(axis=1)
    assert np.sqrt((normal_part**2).sum() / (slide**2).sum()) < 0.6
    assert np.linalg.norm(slide, axis=1).max() > 2.5


def test_own_variation_has_the_stated_size() -> None:
    rng = np.random.default_rng(0)
    own = fd.own_field(rng)
    probe = rng.uniform([-48, -42, -8], [48, 34, 70], size=(4000, 3))
    assert np.sqrt((own(probe) ** 2).sum(axis=1).mean()) == pytest.approx(0.6, rel=0.15)
    assert np.abs(own(np.array([[0.0, 5.0, 150.0]]))).max() < 1e-3


def test_scores_are_spread_and_hardly_correlated() -> None:
    scores = fd.spread_scores(12, 5, np.random.default_rng(0))
    assert np.allclose(scores.mean(axis=0), 0, atol=1e-12)
    assert np.abs(np.corrcoef(scores.T) - np.eye(5)).max() < 0.4


def test_scans_are_closed_and_the_truth_lies_on_them(cohort: Path) -> None:
    truth = np.load(cohort / "truth.npz")
    counts = set()
    for i, shape_id in enumerate(truth["ids"]):
        mesh = read_mesh(cohort / "scans" / f"{shape_id}.ply")
        faces = bone(mesh)
        counts.add(len(faces))
        assert 4000 < len(faces) < 16000
        used = np.unique(faces)
        assert len(used) - len(faces) / 2 == 2  # a closed surface without handles
        assert igl.boundary_loop(faces).size == 0
        corners = mesh.vertices[faces]
        assert (
            np.einsum(
                "ij,ij->", corners[:, 0] - corners[0, 0], np.cross(*(corners[:, k] - corners[0, 0] for k in (1, 2)))
            )
            > 0
        )
        distance = np.sqrt(igl.point_mesh_squared_distance(truth["points"][i], mesh.vertices, faces)[0])
        assert np.sqrt((distance**2).mean()) < 0.2
        assert distance.max() < 1.0
    assert len(counts) == N  # own connectivity each


def test_debris_is_where_the_truth_says(cohort: Path) -> None:
    debris = json.loads((cohort / "truth.json").read_text())["debris"]
    assert debris == ["femur_02", "femur_03"]
    for i in range(N):
        mesh = read_mesh(cohort / "scans" / f"femur_{i + 1:02d}.ply")
        n_parts = igl.facet_components(mesh.faces)[0]
        assert n_parts == (3 if f"femur_{i + 1:02d}" in debris else 1)


def test_tables_agree_with_the_truth(cohort: Path) -> None:
    truth = np.load(cohort / "truth.npz")
    table = read_cohort(cohort / "cohort.csv")
    marks = read_landmarks(cohort / "landmarks.json")
    assert list(table) == list(marks) == truth["ids"].tolist()
    for i, row in enumerate(table.values()):
        assert (np.linalg.det(truth["pose"][i][:3, :3]) < 0) == (row["side"] == "L")
    assert {row["group"] for row in table.values()} == {"a", "b"}
    for i, named in enumerate(marks.values()):
        assert tuple(named) == fd.LANDMARKS
        assert (
            np.abs(
                np.array(list(named.values())) - carried(truth, 0, i, np.array(list(marks["femur_01"].values())))
            ).max()
            < 0.35
        )


def carried(truth: dict[str, np.ndarray], source: int, target: int, points: np.ndarray) -> np.ndarray:
    """Carry points of one shape to another by the truth."""
    faces = truth["faces"]
    _, face, foot = igl.point_mesh_squared_distance(points, truth["points"][source], faces)
    corners = [np.ascontiguousarray(truth["points"][source][faces[face, k]]) for k in range(3)]
    weights = igl.barycentric_coordinates(foot, *corners)
    return np.einsum("nk,nkd->nd", weights, truth["points"][target][faces[face]])


def test_truth_follows_its_formula(cohort: Path) -> None:
    """Pose undone, size undone, modes taken off: only the small field of its own is left."""
    truth = np.load(cohort / "truth.npz")
    for pose, scores, points in zip(truth["pose"], truth["scores"], truth["points"], strict=True):
        canonical = fd.apply(np.linalg.inv(pose), points) / (1 + 0.05 * scores[0])
        rest = canonical - truth["template"] - np.tensordot(scores[1:], truth["modes"][1:], axes=1)
        assert 0.1 < np.sqrt((rest**2).sum(axis=1).mean()) < 1.2


def test_same_seed_same_bytes(cohort: Path, tmp_path: Path) -> None:
    fd.write_cohort(tmp_path / "again", n=N, seed=5, spacing=3.2)
    files = sorted(p.relative_to(cohort) for p in cohort.rglob("*") if p.is_file())
    assert len(files) == N + 4
    assert all((cohort / f).read_bytes() == (tmp_path / "again" / f).read_bytes() for f in files)


def test_one_shape_is_no_cohort(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least 2"):
        fd.write_cohort(tmp_path, n=1)


def test_committed_cohort_is_small_and_complete() -> None:
    files = [p for p in COMMITTED.rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) < 3_000_000
    assert len(list((COMMITTED / "scans").glob("*.ply"))) == 6
    scores = np.load(COMMITTED / "truth.npz")["scores"]
    assert np.allclose(scores, fd.spread_scores(6, 5, np.random.default_rng([0, 0])))
