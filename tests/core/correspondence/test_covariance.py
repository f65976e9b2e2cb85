import numpy as np
import pytest

from ssmpipe.core.correspondence import covariance
from ssmpipe.core.correspondence.covariance import (
    CHOLESKY_FROM,
    Spectrum,
    centred_spectrum,
    parameter_adjoint,
    spectral_adjoint,
)
from ssmpipe.core.correspondence.spectral import SpectralFunction, spectral_function


def cohort(n_shapes, n_landmarks=700):
    rng = np.random.default_rng(0)
    modes = np.geomspace(3.0, 1e-3, 30)[:, None] * rng.normal(size=(30, n_landmarks * 3))
    points = (rng.normal(size=(n_shapes, 30)) @ modes).reshape(n_shapes, n_landmarks, 3)
    weights = rng.uniform(1, 2, n_landmarks)
    return points, weights / weights.sum()


def test_log_determinant_by_cholesky_equals_the_eigenvalues():
    points, weights = cohort(CHOLESKY_FROM + 20)
    centred, spec = centred_spectrum(points, weights)
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
    points, weights = cohort(80)
    centred, spec = centred_spectrum(points, weights)
    function = spectral_function("description-length", cut)
    assert np.count_nonzero(spec.eigenvalues > cut) == n_above
    columns = centred.reshape(80, -1)
    expected = spec.slope(function) @ columns
    got = spec.slope_product(function)(columns)
    np.testing.assert_allclose(got, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("evaluator", ["numpy", "numba"])
def test_any_number_of_threads_and_either_evaluator_gives_the_same_bits(evaluator):
    if evaluator == "numba":
        pytest.importorskip("numba")
    points, weights = cohort(12, 3000)
    tangents = tuple(np.random.default_rng(1).normal(size=(2, *points.shape)))
    function = spectral_function("description-length", 1.0)
    found = []
    for threads, name in [(1, "numpy"), *((t, evaluator) for t in (1, 2, 3))]:
        centred, spec = centred_spectrum(points, weights, threads=threads, evaluator=name)
        out = np.empty((12, 2, 3000))
        parameter_adjoint(
            centred, weights, spec.slope_product(function), tangents, out, threads=threads, evaluator=name
        )
        found.append((centred.tobytes(), spec.gram.tobytes(), out.tobytes()))
    assert all(f == found[0] for f in found)
    expected = spectral_adjoint(centred, weights, spec.slope_product(function))
    np.testing.assert_allclose(out[:, 1], (expected * tangents[1]).sum(axis=-1), atol=1e-12 * np.abs(out).max())


def test_gram_matrix_is_that_of_the_definition():
    points, weights = cohort(9)
    centred, spec = centred_spectrum(points, weights)
    np.testing.assert_allclose(centred, points - points.mean(axis=0), atol=1e-12)
    expected = np.einsum("ild,jld,l->ij", centred, centred, weights) / 8
    np.testing.assert_allclose(spec.gram, expected, rtol=1e-10, atol=1e-12)
