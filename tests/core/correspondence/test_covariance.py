import numpy as np
import pytest

from ssmpipe.core.correspondence import covariance
from ssmpipe.core.correspondence.covariance import CHOLESKY_FROM, Spectrum, centre, spectral_adjoint, spectrum
from ssmpipe.core.correspondence.spectral import SpectralFunction, spectral_function


def cohort(n_shapes, n_landmarks=700):
    rng = np.random.default_rng(0)
    modes = np.geomspace(3.0, 1e-3, 30)[:, None] * rng.normal(size=(30, n_landmarks * 3))
    points = (rng.normal(size=(n_shapes, 30)) @ modes).reshape(n_shapes, n_landmarks, 3)
    weights = rng.uniform(1, 2, n_landmarks)
    return centre(points), weights / weights.sum()


def test_log_determinant_by_cholesky_equals_the_eigenvalues():
    centred, weights = cohort(CHOLESKY_FROM + 20)
    spec = spectrum(centred, weights)
    fast = spectral_function("log-determinant", 1e-3)
    slow = SpectralFunction(fast.value, fast.slope, fast.curvature)
    assert slow.shift == 0
    assert abs(spec.value(fast) - spec.value(slow)) < 1e-8 * abs(spec.value(slow))
    a, b = (spectral_adjoint(centred, weights, spec.slope_product(f)) for f in (fast, slow))
    assert np.abs(a - b).max() < 1e-8 * np.abs(b).max()


def test_log_determinant_of_many_shapes_takes_no_eigenvalues(monkeypatch):
    spec = Spectrum(np.eye(CHOLESKY_FROM))
    monkeypatch.setattr(covariance.np.linalg, "eigh", lambda a: 1 / 0)
    function = spectral_function("log-determinant", 1.0)
    spec.value(function)
    spec.slope(function)


@pytest.mark.parametrize(("cut", "n_above"), [(1e9, 0), (5.0, 4), (1e-9, 30)])
def test_few_modes_above_the_threshold_give_the_product_of_all(cut, n_above):
    centred, weights = cohort(80)
    spec = spectrum(centred, weights)
    function = spectral_function("description-length", cut)
    assert np.count_nonzero(spec.eigenvalues > cut) == n_above
    columns = centred.reshape(80, -1)
    expected = spec.slope(function) @ columns
    got = spec.slope_product(function)(columns)
    np.testing.assert_allclose(got, expected, atol=1e-8 * np.abs(expected).max())


def test_any_number_of_threads_gives_the_same_bits():
    centred, weights = cohort(12)
    grams = [spectrum(centred, weights, threads).gram.tobytes() for threads in (1, 2, 3)]
    assert grams[0] == grams[1] == grams[2]


def test_gram_matrix_is_that_of_the_definition():
    centred, weights = cohort(9)
    expected = np.einsum("ild,jld,l->ij", centred, centred, weights) / 8
    np.testing.assert_allclose(spectrum(centred, weights).gram, expected, rtol=1e-10, atol=1e-12)
