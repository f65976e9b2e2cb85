import numpy as np
import pytest

from ssmpipe.core.evaluation.measures import compactness, generalization, specificity
from ssmpipe.core.model.pca import principal_components


def test_generalization_equals_the_obvious_loop():
    points = np.random.default_rng(0).normal(size=(6, 8, 3))
    expected = np.empty((6, 4))
    for left_out in range(6):
        mean, modes, _, _ = principal_components(np.delete(points, left_out, axis=0))
        difference = (points[left_out] - mean).ravel()
        for m in range(1, 5):
            basis = modes[:m].reshape(m, -1)
            rest = difference - basis.T @ (basis @ difference)
            expected[left_out, m - 1] = np.sqrt((rest**2).sum() / 8)
    mean, error = generalization(points, 4)
    np.testing.assert_allclose(mean, expected.mean(axis=0), rtol=1e-10)
    np.testing.assert_allclose(error, expected.std(axis=0, ddof=1) / np.sqrt(5), rtol=1e-10)


def test_shapes_on_one_line_generalize_without_error():
    direction = np.random.default_rng(1).normal(size=(5, 3))
    points = direction * np.array([-2.0, -1.0, 0.5, 3.0])[:, None, None]
    assert generalization(points, 2)[0][0] == pytest.approx(0.0, abs=1e-6)


def test_specificity_equals_the_obvious_loop():
    points = np.random.default_rng(2).normal(size=(5, 7, 3))
    mean, modes, variances, _ = principal_components(points)
    draws = np.random.default_rng(9).standard_normal((40, 4)) * np.sqrt(variances)
    expected = []
    for m in range(1, 4):
        shapes = mean + np.einsum("sm,mld->sld", draws[:, :m], modes[:m])
        distance = np.sqrt(((shapes[:, None] - points[None]) ** 2).sum(axis=(2, 3)) / 7)
        expected.append(distance.min(axis=1).mean())
    np.testing.assert_allclose(
        specificity(points, 3, n_samples=40, rng=np.random.default_rng(9))[0], expected, rtol=1e-10
    )


def test_compactness_ends_at_one():
    assert compactness(np.array([5.0, 3.0, 2.0]), 4)[0][-1] == pytest.approx(1.0)
