import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.fit import fit_surface, surface_grid


def grid(n):
    return np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")


def test_reproduces_a_surface_of_the_spline_space():
    u, v = grid(40)
    samples = np.stack([u, v, u**2 - u * v + 3 * v**2], axis=-1)
    surface = fit_surface(samples, n_control=(7, 5))
    np.testing.assert_allclose(surface_grid(surface, 40, 40), samples, atol=1e-12)


@pytest.mark.parametrize("degree", [2, 3])
def test_error_falls_with_the_order_of_the_degree(degree):
    u, v = grid(400)
    samples = np.stack([u, v, np.sin(4 * u) * np.cos(3 * v)], axis=-1)
    errors = []
    counts = np.array([8, 16, 32])
    for n in counts:
        surface = fit_surface(samples, degree=(degree, degree), n_control=(n + degree, n + degree))
        errors.append(np.sqrt(((surface_grid(surface, 400, 400) - samples) ** 2).mean()))
    rates = -np.diff(np.log(errors)) / np.log(2)
    np.testing.assert_allclose(rates, degree + 1, atol=0.25)


def test_boundary_depends_on_boundary_samples_only_and_ends_are_met():
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(30, 30, 3))
    other = samples.copy()
    other[1:-1, 1:-1] += 1.0
    a, b = fit_surface(samples, n_control=(8, 8)), fit_surface(other, n_control=(8, 8))
    np.testing.assert_array_equal(a.control_points[0], b.control_points[0])
    np.testing.assert_allclose(a.control_points[[0, -1]][:, [0, -1]], samples[[0, -1]][:, [0, -1]])


def test_fairness_smooths():
    rng = np.random.default_rng(1)
    u, v = grid(60)
    samples = np.stack([u, v, 0.1 * rng.normal(size=u.shape)], axis=-1)
    plain = fit_surface(samples, n_control=(30, 30)).control_points
    fair = fit_surface(samples, n_control=(30, 30), fairness=1e-4).control_points
    assert np.diff(fair[..., 2], 2, axis=0).std() < 0.2 * np.diff(plain[..., 2], 2, axis=0).std()


def test_refuses_too_few_samples():
    with pytest.raises(GeometryError, match="10 samples cannot determine 20 control points"):
        fit_surface(np.zeros((10, 10, 3)), n_control=(20, 20))
