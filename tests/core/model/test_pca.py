import numpy as np

from ssmpipe.core.model.pca import principal_components


def test_agrees_with_the_covariance_matrix():
    points = np.random.default_rng(0).normal(size=(7, 5, 3))
    mean, modes, variances, scores = principal_components(points)
    covariance = np.cov(points.reshape(7, -1), rowvar=False)
    np.testing.assert_allclose(variances, np.linalg.eigvalsh(covariance)[::-1][:6], rtol=1e-10)
    flat = modes.reshape(6, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(6), atol=1e-10)
    np.testing.assert_allclose(covariance @ flat.T, flat.T * variances, atol=1e-10)
    back = mean + np.einsum("im,mld->ild", scores * np.sqrt(variances), modes)
    np.testing.assert_allclose(back, points, atol=1e-10)
    np.testing.assert_allclose(scores.std(axis=0, ddof=1), 1.0)


def test_rank_deficient_cohort_has_fewer_modes():
    base = np.random.default_rng(1).normal(size=(1, 4, 3))
    points = base * np.array([1.0, 2.0, 3.0, 4.0])[:, None, None]
    assert len(principal_components(points)[2]) == 1
