import numpy as np
from scipy.spatial.transform import Rotation

from ssmpipe.core.align.procrustes import generalized_procrustes


def test_recovers_known_motions_and_sizes():
    rng = np.random.default_rng(0)
    base = rng.normal(size=(40, 3)) * [5, 3, 1]
    weights = rng.random(40)
    weights /= weights.sum()
    sizes = np.array([0.9, 1.0, 1.1, 1.2])
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(4, 3))).as_matrix()
    points = np.einsum("iab,ilb->ila", turns, base * sizes[:, None, None]) + rng.normal(size=(4, 1, 3)) * 10
    a = generalized_procrustes(points, weights, remove_size=True)
    moved = np.einsum("iab,ilb->ila", a.rotation, points) + a.translation[:, None]
    scaled = a.centre + a.scale[:, None, None] * (moved - a.centre)
    np.testing.assert_allclose(scaled, np.repeat(scaled[:1], 4, axis=0), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(a.rotation), 1.0)
    np.testing.assert_allclose(a.scale * sizes, (a.scale * sizes)[0], rtol=1e-9)


def test_aligned_shapes_stay():
    base = np.random.default_rng(1).normal(size=(20, 3))
    a = generalized_procrustes(np.stack([base, base, base]), np.full(20, 0.05), remove_size=False)
    np.testing.assert_allclose(a.rotation, np.repeat(np.eye(3)[None], 3, axis=0), atol=1e-9)
    np.testing.assert_allclose(a.translation, 0.0, atol=1e-9)
    np.testing.assert_array_equal(a.scale, np.ones(3))
