"""The examples of docs/python.md are tests."""

import doctest
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ssmpipe
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.pca import principal_components
from tests.support.models import curve_model, shape_model, write_model

PAGE = Path(__file__).parents[2] / "docs" / "python.md"


def test_every_example_of_the_page_is_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_model(shape_model("tube"), tmp_path / "out" / "tubes")
    monkeypatch.chdir(tmp_path)
    found = doctest.testfile(str(PAGE), module_relative=False, encoding="utf-8")
    assert found.attempted > 20
    assert found.failed == 0


def test_likelihood_is_that_of_probabilistic_principal_components(tmp_path: Path) -> None:
    from scipy.stats import multivariate_normal

    points = np.random.default_rng(1).normal(size=(7, 12, 3))
    mean, modes, variances, scores = principal_components(points)
    shapes = replace(shape_model("disk", 4, 3), mean=mean, modes=modes, variances=variances, scores=scores)
    model = ssmpipe.load_model(write_model(replace(shapes, ids=tuple("abcdefg")), tmp_path))
    noise = model.remainder.variance + model.remainder.noise
    flat = model.modes.reshape(len(model.modes), -1)
    covariance = (flat.T * model.variances) @ flat + noise * np.eye(flat.shape[1])
    other = np.random.default_rng(0).normal(size=mean.shape)
    expected = multivariate_normal(mean.ravel(), covariance).logpdf(other.ravel())
    assert model.log_likelihood(other) == pytest.approx(float(expected), rel=1e-6)


def test_what_a_model_cannot_do_is_said(tmp_path: Path) -> None:
    curves = ssmpipe.load_model(write_model(curve_model(), tmp_path / "a"))
    with pytest.raises(ConfigError, match="a model of curves"):
        curves.complete(TriMesh(np.eye(3), np.array([[0, 1, 2]])))
    two = ssmpipe.load_model(write_model(shape_model("disk", 4, 3, 2), tmp_path / "b"))
    with pytest.raises(ConfigError, match="holds 2 shapes, at least 3"):
        _ = two.remainder
