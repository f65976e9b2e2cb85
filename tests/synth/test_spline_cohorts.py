"""The synthetic spline cohorts: what the thesis prints is met, and the truth about them is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.spline.fit_curve import curve_points
from ssmpipe.io.landmarks import read_landmarks
from ssmpipe.io.splines import read_spline
from ssmpipe.synth import arcs, box_bump, hand, line_bump, plane_bump

STRONG_FIRST = (30.0, 10.0, 3.0, 1.0, 0.1, 0.01, 0.001)
MODULES = {"box-bump": box_bump, "line-bump": line_bump, "arcs": arcs, "plane-bump": plane_bump}


def load(folder: Path) -> tuple[list, dict[str, np.ndarray]]:
    with np.load(folder / "truth.npz") as data:
        truth = {name: data[name] for name in data.files}
    return [read_spline(folder / "scans" / f"{i}.npz") for i in truth["ids"]], truth


@pytest.mark.parametrize("name", [*MODULES, "hand"])
def test_files_repeat_and_landmarks_lie_on_the_shapes(tmp_path: Path, name: str) -> None:
    module = MODULES.get(name, hand)
    more = {"n": 4} if name == "hand" else {}
    for part in ("a", "b"):
        module.write_cohort(tmp_path / part, seed=3, **more)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 4 + 3
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    splines, truth = load(tmp_path / "a")
    table = read_landmarks(tmp_path / "a" / "landmarks.csv")
    assert sorted(table) == truth["ids"].tolist()
    assert all(np.array_equal(s.knot_vectors[0], splines[0].knot_vectors[0]) for s in splines)
    if splines[0].dimension == 2:
        for spline, points in zip(splines, truth["landmarks"], strict=True):
            dense = curve_points(spline, np.linspace(0, 1, 5001))
            gaps = np.sqrt(((points[:, None] - dense) ** 2).sum(axis=-1)).min(axis=1)
            assert gaps.max() < 0.01 * np.linalg.norm(np.ptp(dense, axis=0))


def test_printed_dimensions_of_the_boxes(tmp_path: Path) -> None:
    box_bump.write_cohort(tmp_path)
    curves, truth = load(tmp_path)
    assert truth["centres"].tolist() == [15, 25, 35, 45]
    dense = curve_points(curves[0], np.linspace(0, 1, 2001))
    np.testing.assert_allclose(dense.min(axis=0), [0, 0], atol=0.1)
    assert dense[:, 0].max() == pytest.approx(60, abs=0.1)
    # parameters of bump corners, bump top and upper left corner of shape 2, printed beside figure 2.6
    np.testing.assert_allclose(truth["features"][1, 3:7], [0.60, 0.71, 0.82, 0.89], atol=0.011)
    # the features are where the desired reparameterization carries those of shape 2
    for feature, desired in zip(truth["features"], truth["desired"], strict=True):
        np.testing.assert_allclose(np.interp(truth["features"][1], truth["u"], desired), feature, atol=1e-3)


def test_arcs_have_the_printed_covariance(tmp_path: Path) -> None:
    arcs.write_cohort(tmp_path)
    curves, truth = load(tmp_path)
    u = (np.arange(20000) + 0.5) / 20000
    points = np.stack([curve_points(c, u) for c in curves])
    centred = points - points.mean(axis=0)
    speed = np.linalg.norm(np.gradient(points.mean(axis=0), u, axis=0), axis=1)
    for weights, norm in zip((np.ones_like(u), speed), truth["norms"], strict=True):
        gram = np.einsum("ild,jld,l->ij", centred, centred, weights / weights.sum()) / 3
        assert np.linalg.norm(gram) == pytest.approx(norm, abs=1e-4)
    with pytest.raises(ConfigError, match="exactly 4"):
        arcs.write_cohort(tmp_path, n=5)


def test_hands_are_drawn_from_one_plan(tmp_path: Path) -> None:
    hand.write_cohort(tmp_path, n=6, seed=1)
    curves, truth = load(tmp_path)
    for curve, points, parameters in zip(curves, truth["points"], truth["parameters"], strict=True):
        assert np.linalg.norm(curve_points(curve, parameters) - points, axis=1).max() < 1.0
        assert np.all(np.diff(parameters) > 0)
    tips = [i for i, name in enumerate(truth["landmark_names"]) if name.endswith("tip")]
    valleys = [i for i, name in enumerate(truth["landmark_names"]) if name.startswith("valley")]
    marks = truth["landmarks"]
    for k, valley in enumerate(valleys):
        assert np.all(marks[:, valley, 1] < np.minimum(marks[:, tips[k], 1], marks[:, tips[k + 1], 1]))
    assert np.ptp(truth["features"], axis=0).min() > 0.003, "arc length must not give the correspondence away"


def test_the_engine_finds_the_desired_reparameterization_of_the_boxes(tmp_path: Path) -> None:
    box_bump.write_cohort(tmp_path)
    curves, truth = load(tmp_path)
    options = EngineOptions(
        n_coefficients=(62,), landmarks=(151,), boundary="fixed", covariance="discrete", pose="keep", normalize="none",
        prior=0.0, barriers=STRONG_FIRST, reference=1, lambda_cut=3e-5,
    )  # fmt: skip
    optimum = optimize_correspondence(curves, options).value
    variances = principal_components(optimum.points)[2]
    assert variances[0] / variances.sum() > 0.999
    u = np.linspace(0, 1, 151)
    for found, desired in zip(optimum.parameters, truth["desired"], strict=True):
        assert np.abs(found[:, 0] - np.interp(u, truth["u"], desired)).max() < 0.01
    before, after = optimum.description_length
    assert before == pytest.approx(36.5, abs=1)
    assert after < 17
    assert all(c.verdict == "proved" for c in optimum.certificates)


def test_line_bump_becomes_one_mode(tmp_path: Path) -> None:
    line_bump.write_cohort(tmp_path)
    curves, _ = load(tmp_path)
    assert {len(c.control_points) for c in curves} == {12}
    options = EngineOptions(
        n_coefficients=(16,), landmarks=(19,), boundary="fixed", covariance="II", quadrature="midpoint", pose="keep",
        normalize="none", prior=0.0, barriers=STRONG_FIRST, reference=1, lambda_cut=3e-5,
    )  # fmt: skip
    optimum = optimize_correspondence(curves, options).value
    variances = principal_components(optimum.points)[2]
    assert variances[0] / variances.sum() > 0.999


def test_plane_bump_is_what_its_formula_says(tmp_path: Path) -> None:
    plane_bump.write_cohort(tmp_path)
    surfaces, truth = load(tmp_path)
    assert all(s.control_points.shape == (11, 11, 3) for s in surfaces)
    np.testing.assert_allclose(np.diff(truth["means"]), np.diff(truth["means"])[0])
    np.testing.assert_allclose(truth["features"][1, 0], [0.45, 0.5], atol=0.01)
    np.testing.assert_allclose(np.abs(truth["features"][1, 1:] - truth["features"][1, 0]).max(axis=1), 0.28, atol=0.015)
    peaks = truth["landmarks"][:, 0]
    np.testing.assert_allclose(peaks[:, 0], truth["means"], atol=0.3)
    np.testing.assert_allclose(peaks[:, 2], plane_bump.HEIGHT, atol=2.0)
