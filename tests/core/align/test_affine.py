import numpy as np

from ssmpipe.core.align.affine import affine_to_mean


def test_affine_copies_become_one_shape():
    rng = np.random.default_rng(0)
    base = rng.normal(size=(50, 3)) * [5, 3, 2]
    maps = np.eye(3) + 0.15 * rng.normal(size=(5, 3, 3))
    points = np.einsum("iab,lb->ila", maps, base) + rng.normal(size=(5, 1, 3))
    linear, offset = affine_to_mean(points, np.full(50, 0.02), ridge=1e-9, n_iterations=30)
    moved = np.einsum("iab,ilb->ila", linear, points) + offset[:, None]
    np.testing.assert_allclose(moved, np.repeat(moved[:1], 5, axis=0), atol=1e-6)
    np.testing.assert_allclose(linear.mean(axis=0), np.eye(3), atol=1e-12)


def test_flat_shapes_keep_their_normal():
    rng = np.random.default_rng(1)
    base = np.concatenate([rng.normal(size=(30, 2)), np.zeros((30, 1))], axis=1)
    points = np.stack([base, base * [1.2, 1, 1], base * [1, 0.9, 1]])
    linear, _ = affine_to_mean(points, np.full(30, 1 / 30))
    np.testing.assert_allclose(linear[:, 2], np.repeat([[0, 0, 1.0]], 3, axis=0), atol=1e-9)
