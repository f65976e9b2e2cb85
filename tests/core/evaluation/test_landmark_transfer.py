import numpy as np
import pytest

from ssmpipe.core.evaluation.landmark_transfer import landmark_transfer
from ssmpipe.core.mesh.grid import grid_faces


def flat(n=11):
    u, v = np.meshgrid(np.linspace(0, 10, n), np.linspace(0, 10, n), indexing="ij")
    return np.stack([u, v, np.zeros_like(u)], axis=-1).reshape(-1, 3)


def test_error_is_the_distance_of_the_carried_point():
    points = np.stack([flat(), flat() + [0, 0, 5.0]])
    landmarks = {"a": {"tip": np.array([3.3, 4.4, 0.0])}, "b": {"tip": np.array([3.3, 6.4, 5.0])}}
    (transfer,) = landmark_transfer(points, grid_faces(11, 11), ["a", "b"], landmarks)
    np.testing.assert_allclose(transfer.off_diagonal(), [2.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(transfer.errors), 0.0, atol=1e-12)


def test_a_landmark_off_the_corresponded_part_is_left_out():
    points = np.stack([flat(), flat(), flat()])
    tip = np.array([3.0, 4.0, 0.0])
    landmarks = {"a": {"tip": tip}, "b": {"tip": tip}, "c": {"tip": tip + [0, 0, 9.0]}}
    (transfer,) = landmark_transfer(points, grid_faces(11, 11), ["a", "b", "c"], landmarks)
    assert transfer.ids == ("a", "b")
    assert transfer.off_diagonal().max() == pytest.approx(0.0)
