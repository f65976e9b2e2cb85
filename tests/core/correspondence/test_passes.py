import numpy as np
import pytest

from ssmpipe.core.correspondence.passes import centre_and_scale, contract


@pytest.mark.parametrize(("n_shapes", "dimension"), [(7, 3), (2, 2), (1, 3)])
def test_numpy_and_numba_give_the_same_bits_and_leave_other_landmarks_alone(n_shapes, dimension):
    pytest.importorskip("numba")
    rng = np.random.default_rng(0)
    points = rng.normal(size=(n_shapes, 30, dimension))
    tangents = tuple(rng.normal(size=(2, n_shapes, 30, dimension)))
    factor = rng.random(30)
    found = []
    for evaluator in ("numpy", "numba"):
        centred, out = np.zeros_like(points), np.zeros((n_shapes, 2, 30))
        scaled = centre_and_scale(points, factor, centred, slice(11, 24), evaluator)
        contract(scaled, factor, tangents, out, slice(11, 24), evaluator)
        found.append((centred.tobytes(), scaled.tobytes(), out.tobytes()))
    assert found[0] == found[1]
    inside = np.zeros(30, dtype=bool)
    inside[11:24] = True
    assert not centred[:, ~inside].any()
    assert not out[..., ~inside].any()
    expected = points - points.mean(axis=0)
    np.testing.assert_allclose(centred[:, inside], expected[:, inside], atol=1e-14)
    dots = np.einsum("ild,cild->icl", factor[:, None] * expected, np.stack(tangents)) * factor
    np.testing.assert_allclose(out[..., inside], dots[..., inside], atol=1e-13)
