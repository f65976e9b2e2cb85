import numpy as np

from ssmpipe.core.model.remainder import Remainder, _one_by_one, farthest_first, fit_remainder, leave_one_out


def test_leave_one_out_in_closed_form_is_that_of_one_model_after_the_other():
    points = np.random.default_rng(0).normal(size=(7, 30, 3)) * np.linspace(3, 1, 30)[:, None]
    fast = leave_one_out(points)
    slow = _one_by_one((points - points.mean(axis=0)).reshape(7, -1), points.shape)
    np.testing.assert_allclose(fast.residuals, slow.residuals, atol=1e-10)
    np.testing.assert_allclose(fast.mahalanobis, slow.mahalanobis, rtol=1e-9)


def test_shapes_that_depend_on_each_other_leave_no_residual():
    line = np.array([0.0, 1, 2, 6])[:, None, None] * np.random.default_rng(1).normal(size=(1, 20, 3))
    found = leave_one_out(line)
    np.testing.assert_allclose(found.residuals, 0, atol=1e-9)
    assert found.mahalanobis[3] == found.mahalanobis.max()


def test_a_process_is_recovered_from_its_samples():
    rng = np.random.default_rng(0)
    mean = rng.uniform(-50, 50, size=(200, 3))
    size = np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean())
    truth = Remainder(4.0, 0.5 * size, 0.2)
    covariance = truth.kernel(mean, mean) + 0.2 * np.eye(200)
    samples = np.moveaxis(np.linalg.cholesky(covariance) @ rng.normal(size=(200, 20 * 3)), 1, 0)
    found = fit_remainder(samples.reshape(20, 3, 200).transpose(0, 2, 1), mean)
    assert abs(found.length - truth.length) < 1e-9
    assert 3.0 < found.variance < 5.2
    assert 0.05 < found.noise < 0.4


def test_no_residual_gives_next_to_no_remainder():
    mean = np.random.default_rng(0).normal(size=(40, 3))
    found = fit_remainder(np.zeros((3, 40, 3)), mean)
    assert 0 < found.variance < 1e-10


def test_spread_points_are_far_from_each_other():
    points = np.random.default_rng(0).uniform(size=(500, 2))
    chosen = farthest_first(points, 20)
    gaps = np.linalg.norm(points[chosen][:, None] - points[chosen][None], axis=2)[np.triu_indices(20, 1)]
    assert gaps.min() > 0.12
    assert np.array_equal(farthest_first(points[:5], 20), np.arange(5))
