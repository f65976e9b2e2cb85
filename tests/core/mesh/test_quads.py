import numpy as np
import pytest

from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.quads import grid_quads, scaled_jacobian


@pytest.mark.parametrize("angle", [90, 60, 30, 120])
def test_the_scaled_jacobian_of_a_parallelogram_is_the_sine_of_its_angle(angle: float) -> None:
    side = 3 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
    points = np.array([[0, 0, 0], [2, 0, 0], side + [2, 0, 0], side])
    assert scaled_jacobian(points, np.array([[0, 1, 2, 3]]))[0] == pytest.approx(np.sin(np.radians(angle)))


def test_a_dart_is_negative_and_a_triangle_is_zero() -> None:
    dart = np.array([[0, 0, 0], [2, 0, 0], [0.3, 0.3, 0], [0, 2, 0.0]])
    assert scaled_jacobian(dart, np.array([[0, 1, 2, 3]]))[0] < 0
    assert scaled_jacobian(dart, np.array([[0, 1, 1, 3]]))[0] == 0


@pytest.mark.parametrize("periodic", [False, True])
def test_quads_are_the_pairs_of_triangles_of_the_grid(periodic: bool) -> None:
    quads, faces = grid_quads(5, 4, periodic_u=periodic), grid_faces(5, 4, periodic_u=periodic)
    split = np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    assert np.array_equal(split, faces)
