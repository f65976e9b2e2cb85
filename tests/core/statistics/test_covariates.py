import numpy as np
import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.core.statistics.covariates import (
    adjusted_means,
    allometry,
    centroid_size,
    group_contrast,
    pair_contrast,
)

LABELS = np.array([0, 0, 0, 1, 1, 1, 2, 2])


def test_the_contrast_is_orthonormal_and_blind_to_the_nuisance():
    covariates = np.random.default_rng(0).normal(size=(8, 2)) * [1.0, 1e4] + 1e5
    contrast = group_contrast(LABELS, covariates)
    both = np.concatenate([contrast.tested, contrast.nuisance], axis=1)
    assert np.allclose(both.T @ both, np.eye(5), atol=1e-12)
    assert contrast.degrees_of_error == 3
    assert np.allclose(contrast.residuals(covariates), 0, atol=1e-6)
    assert not contrast.constant_only
    assert group_contrast(LABELS).constant_only


def test_adjusted_means_undo_a_known_slope():
    rng = np.random.default_rng(1)
    age = rng.normal(50, 10, size=(8, 1)) + 5.0 * LABELS[:, None]
    truth = np.array([[1.0, 2], [3, 4], [5, 6]])
    values = truth[LABELS] + (age - age.mean()) * [0.3, -0.2]
    means, residuals = adjusted_means(values, LABELS, age)
    assert np.allclose(means, truth)
    assert np.allclose(residuals, 0, atol=1e-9)
    raw, _ = adjusted_means(values, LABELS)
    assert np.allclose(raw[1], values[LABELS == 1].mean(axis=0))
    assert not np.allclose(raw, truth)


def test_confounded_covariates_are_refused():
    with pytest.raises(ConfigError, match="determine the groups"):
        group_contrast(LABELS, (LABELS[:, None] == [1, 2]).astype(float))
    with pytest.raises(ConfigError, match=r"2 covariate columns determine each other \(rank 1\)"):
        group_contrast(LABELS, np.arange(8.0)[:, None] * [1.0, 2.0])
    with pytest.raises(ConfigError, match="or one is constant"):
        group_contrast(LABELS, np.full((8, 1), 3.0))


def test_allometry_of_shapes_that_only_grow():
    base = np.random.default_rng(2).normal(size=(6, 2))
    size = np.exp(np.array([-0.3, 0.1, 0.3, -0.2, 0.0, 0.4]))
    points = np.log(size)[:, None, None] * base + 3.0
    labels = np.array([0, 0, 0, 1, 1, 1])
    assert allometry(points, labels, size) == pytest.approx(1.0)
    assert allometry(np.random.default_rng(0).normal(size=(6, 50, 2)), labels, size) < 0.7


def test_size_ignores_pose_and_number_of_points():
    points = np.random.default_rng(3).normal(size=(1, 7, 3))
    assert np.allclose(centroid_size(2 * points + 5), 2 * centroid_size(points))
    assert np.allclose(centroid_size(np.repeat(points, 3, axis=1)), centroid_size(points))


def test_pairs_are_tested_against_zero():
    contrast = pair_contrast(5)
    assert contrast.degrees_of_error == 4
    assert np.allclose(contrast.residuals(np.arange(5.0)), np.arange(5.0))
