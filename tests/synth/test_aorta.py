"""The synthetic aortas: flawed as promised, and the truth about them is true."""

from __future__ import annotations

import json
from pathlib import Path

import igl
import numpy as np
import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.meshes import read_mesh
from ssmpipe.io.tables import read_cohort
from ssmpipe.synth import aorta
from ssmpipe.synth._scans import apply
from ssmpipe.synth.implicit import field_gradient

N = 4


@pytest.fixture(scope="module")
def cohort(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aorta")
    aorta.write_cohort(folder, n=N, seed=3, spacing=1.1)
    return folder


@pytest.fixture(scope="module")
def truth(cohort: Path) -> dict[str, np.ndarray]:
    return dict(np.load(cohort / "truth.npz"))


def wall(seed: int = 0, size: float = 1.0) -> aorta.Wall:
    rng = np.random.default_rng(seed)
    return aorta.Wall(size * rng.normal(size=7), 0.1 * rng.normal(size=(2, 4, 5)))


def test_material_parameters_are_found_again() -> None:
    shape = wall()
    rng = np.random.default_rng(1)
    theta, t = rng.uniform(-np.pi, np.pi, 500), rng.uniform(-10, 65, 500)
    angle, height, distance = shape.material(shape.point(theta, t))
    assert np.abs(np.exp(1j * angle) - np.exp(1j * theta)).max() < 1e-5
    assert np.abs(height - t).max() < 1e-4
    assert np.allclose(distance, shape.radius(theta, t), atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_wall_is_one_to_one(seed: int) -> None:
    shape = wall(seed, 1.5)
    theta, t = np.linspace(0, 2 * np.pi, 200), np.linspace(-12, 70, 300)
    assert (np.diff(shape.angle(theta)) > 0).all()
    assert (np.diff(shape.height(t)) > 0).all()
    grid = shape.radius(*np.meshgrid(theta, t))
    assert grid.min() > 7
    assert grid.max() < 26 < 0.6 / aorta._CURVATURE  # never as far out as the centre of the bend


def test_wall_of_a_known_shape() -> None:
    straight = aorta.Wall(np.zeros(7), np.zeros((2, 4, 5)))
    foot = straight.point(np.array(0.0), np.array(0.0))
    assert foot[1:].tolist() == [0.0, 0.0]
    assert np.array_equal(straight.point(np.array(0.0), np.array(10.0), 0.0), [0, 0, 10.0])
    arc = straight.point(np.array(0.0), np.array(aorta.HEIGHT), 0.0)  # an arc of radius 75, 36 long, after 20 straight
    assert np.allclose(arc, [75 * (1 - np.cos(0.48)), 0, 20 + 75 * np.sin(0.48)], atol=1e-2)


def test_anatomy_has_real_dimensions(truth: dict[str, np.ndarray]) -> None:
    for points, marks in zip(truth["points"], truth["landmarks"], strict=True):
        rings = points.reshape(*truth["grid"], 3)
        across = np.linalg.norm(rings[:48] - rings[48:], axis=2)
        sinus, junction, tube = across[:, 13].max(), across[:, 27].mean(), across[:, 45].mean()
        assert 28 < sinus < 42
        assert 23 < junction < 33
        assert sinus > junction + 1.5
        assert 24 < tube < 36
        assert 48 < np.linalg.norm(rings.mean(axis=0)[1:] - rings.mean(axis=0)[:-1], axis=1).sum() < 64
        nadirs, grooves = marks[:3], marks[3:6]
        assert np.linalg.norm(nadirs.mean(axis=0) - grooves.mean(axis=0)) == pytest.approx(17, abs=2)


def test_scans_have_the_promised_openings(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    flaws = json.loads((cohort / "truth.json").read_text())["flaws"]
    for shape_id in truth["ids"]:
        mesh = read_mesh(cohort / "scans" / f"{shape_id}.ply")
        flaw = flaws[shape_id]
        loops = igl.boundary_loop_all(mesh.faces)
        n_expected = 1 + (not flaw["closed_top"]) + len(flaw["stumps"]) + len(flaw["holes"])
        assert len(loops) == n_expected
        edges, count = np.unique(
            np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True
        )
        assert count.max() == 2
        assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 2 - n_expected  # genus 0, one piece
        assert len(np.concatenate(loops)) == len(np.unique(np.concatenate(loops)))  # no vertex on two rims
        assert 8000 < len(mesh.faces) < 25000


def test_first_is_closed_and_third_too_short(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    flaws = list(json.loads((cohort / "truth.json").read_text())["flaws"].values())
    assert [flaw["closed_top"] for flaw in flaws] == [True, False, False, False]
    assert [flaw["bottom"] > 0 for flaw in flaws] == [False, False, True, False]
    assert max(flaw["bottom"] for flaw in flaws) < aorta.NADIR
    assert any(flaw["holes"] for flaw in flaws)
    lengths = {length for flaw in flaws for length in flaw["stumps"].values()}
    assert len(lengths) == N
    lowest = truth["covered"].reshape(N, *truth["grid"])[:, :, 0]
    assert lowest[2].sum() == 0
    assert lowest[[0, 1, 3]].all()


def test_covered_truth_lies_on_the_scan(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    for i, shape_id in enumerate(truth["ids"]):
        mesh = read_mesh(cohort / "scans" / f"{shape_id}.ply")
        distance = np.sqrt(igl.point_mesh_squared_distance(truth["points"][i], mesh.vertices, mesh.faces)[0])
        covered = truth["covered"][i]
        assert np.array_equal(distance < aorta.COVERED, covered)
        assert 0.9 < covered.mean() < 1
        assert np.sqrt((distance[covered] ** 2).mean()) < 0.15
        away = ~covered.reshape(truth["grid"])[:, 18]  # the row of the ostia
        assert 0 < away.sum() < 16


def test_faces_look_outward(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    for i, shape_id in enumerate(truth["ids"]):
        axis = truth["points"][i].reshape(*truth["grid"], 3).mean(axis=0)
        mesh = read_mesh(cohort / "scans" / f"{shape_id}.ply")
        for points, faces in ((truth["points"][i], truth["faces"]), (mesh.vertices, mesh.faces)):
            corners = points[faces]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            middle = corners.mean(axis=1)
            nearest = axis[np.linalg.norm(middle[:, None] - axis[None], axis=2).argmin(axis=1)]
            assert ((normal * (middle - nearest)).sum(axis=1) > 0).mean() > 0.9


def test_landmarks_lie_on_the_true_wall(cohort: Path, truth: dict[str, np.ndarray]) -> None:
    table = read_landmarks(cohort / "landmarks.json")
    assert list(table) == truth["ids"].tolist() == list(read_cohort(cohort / "cohort.csv"))
    for i, named in enumerate(table.values()):
        assert tuple(named) == aorta.LANDMARKS
        marks = np.array(list(named.values()))
        assert np.abs(marks - truth["landmarks"][i]).max() < 1e-3
        distance = np.sqrt(igl.point_mesh_squared_distance(marks, truth["points"][i], truth["faces"])[0])
        assert distance[:8].max() < 0.05
        ends = truth["points"][i].reshape(*truth["grid"], 3)[:, [0, -1]].mean(axis=0)
        assert np.linalg.norm(marks[8:] - ends, axis=1).max() < 1.5
        local = apply(np.linalg.inv(truth["pose"][i]), marks)
        assert local[1, 1] > 0 > local[2, 1]  # never mirrored: the right sinus follows the left one counter-clockwise


def test_first_modes_are_diameter_and_sinus_size(tmp_path: Path) -> None:
    n = 8
    scores = aorta.spread_scores(n, 7, np.random.default_rng([0, 0]), n_draws=3000, sizes=aorta.SIZES)
    parameters, _ = aorta.truth_grid()
    shapes = [
        aorta.Wall(s, 0.1 * np.random.default_rng([0, i + 1]).normal(size=(2, 4, 5))) for i, s in enumerate(scores)
    ]
    points = np.stack([w.point(2 * np.pi * parameters[:, 0], aorta.HEIGHT * parameters[:, 1]) for w in shapes])
    points -= points.mean(axis=1, keepdims=True)
    for _ in range(3):
        mean = points.mean(axis=0)
        for i, shape in enumerate(points):
            left, _, right = np.linalg.svd(shape.T @ mean)
            points[i] = shape @ left @ right
    residual = (points - points.mean(axis=0)).reshape(n, -1)
    left, singular, _ = np.linalg.svd(residual, full_matrices=False)
    share = singular**2 / (singular**2).sum()
    assert share[0] > 0.6
    assert 0.1 < share[1] < 0.25
    assert share[2] < 0.1
    found = np.abs(np.corrcoef(np.column_stack([left[:, :2], scores]).T)[:2, 2:])
    assert found[0].argmax() == 0
    assert found[1].argmax() == 1
    assert found[[0, 1], [0, 1]].min() > 0.9


def test_normals_of_the_field_point_outward() -> None:
    shape = wall()
    theta = np.linspace(0, 6, 30)
    points = shape.point(theta, np.full(30, 30.0))
    outward = points - shape.point(theta, np.full(30, 30.0), 0.9)
    assert np.abs(shape.field(points)).max() < 1e-4
    assert ((field_gradient(shape.field, points) * outward).sum(axis=1) > 0).all()


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        aorta.write_cohort(tmp_path / name, n=3, seed=5, spacing=2.4)
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(files) == 3 + 4
    assert all((tmp_path / "one" / f).read_bytes() == (tmp_path / "two" / f).read_bytes() for f in files)


def test_two_shapes_are_no_cohort(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at least 3 shapes, got 2"):
        aorta.write_cohort(tmp_path, n=2)
