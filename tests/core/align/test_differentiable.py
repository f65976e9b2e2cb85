import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssmpipe.core.align.differentiable import align_to, align_to_adjoint
from tests.support.surfaces import taylor_rate


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_adjoint_is_exact(d, seed):
    rng = np.random.default_rng(seed)
    target = rng.normal(size=(20, d)) * np.arange(1, d + 1)
    points = target + 0.4 * rng.normal(size=(20, d)) + 3.0
    weights = rng.random(20)
    weights /= weights.sum()
    pull = rng.normal(size=(20, d))

    def value(x):
        moved = align_to(x, target, weights)[0]
        return float((pull * moved).sum() + (moved**3).sum())

    moved, rotation = align_to(points, target, weights)
    gradient = align_to_adjoint(points, target, weights, rotation, pull + 3 * moved**2)
    direction = rng.normal(size=points.shape)
    flat = taylor_rate(lambda y: value(y.reshape(points.shape)), gradient.ravel(), points.ravel(), direction.ravel())
    assert flat > 1.8


def test_rigid_motion_is_undone():
    rng = np.random.default_rng(4)
    target = rng.normal(size=(15, 3))
    turn = Rotation.from_rotvec([0.2, 0.9, -0.4]).as_matrix()
    weights = np.full(15, 1 / 15)
    np.testing.assert_allclose(align_to(target @ turn.T + 4.0, target, weights)[0], target, atol=1e-12)
