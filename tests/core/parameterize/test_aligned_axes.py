import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssmpipe.core.align.rigid import move
from ssmpipe.core.mesh.primitives import flat_square
from ssmpipe.core.parameterize.boundary import aligned_axes, rim_of


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_axes_lie_in_the_plane_follow_the_frame_and_vary_little(seed, flip):
    square = flat_square(6)
    tilt = np.eye(4)
    turn = np.random.default_rng(seed).normal(size=3)
    tilt[:3, :3] = Rotation.from_rotvec(0.5 * turn / np.linalg.norm(turn)).as_matrix()
    if flip:
        tilt[:3, :3] = tilt[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    tilted = move(square, tilt)
    axes, margin = aligned_axes(tilted, rim_of(tilted))
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(axes @ tilt[:3, 2], 0.0, atol=1e-12)
    assert axes[0] @ np.eye(3)[0] > 0.8
    assert axes[1] @ np.eye(3)[1] > 0.8
    assert margin > 0
