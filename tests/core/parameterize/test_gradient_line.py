from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape
from ssmpipe.core.parameterize.geodesic import SurfacePath
from ssmpipe.core.parameterize.gradient_line import gradient_line
from tests.support.meshes import noisy


def points(mesh, line: SurfacePath) -> np.ndarray:
    a, b = mesh.vertices[line.edges[:, 0]], mesh.vertices[line.edges[:, 1]]
    return a + line.fraction[:, None] * (b - a)


def along(values, line: SurfacePath) -> np.ndarray:
    a, b = values[line.edges[:, 0]], values[line.edges[:, 1]]
    return a + line.fraction * (b - a)


@pytest.mark.parametrize("slope", [(1.0, 0.3), (0.2, 1.0), (1.0, 1.0), (0.9, 0.0)])
def test_a_linear_function_is_climbed_straight(slope):
    square = flat_square(8, 7.0)
    start = int(np.argmin(np.linalg.norm(square.vertices[:, :2] - [1.0, 1.0], axis=1)))
    line = gradient_line(square, square.vertices[:, :2] @ slope, start)
    way = points(square, line)[:, :2] - square.vertices[start, :2]
    # through vertices that lie nearer than the snapping distance it bends
    assert np.abs(way @ [-slope[1], slope[0]]).max() / np.linalg.norm(slope) < 0.03
    assert np.isclose(points(square, line)[-1, :2].max(), 7.0)
    assert line.length == pytest.approx(np.linalg.norm(way[-1]), rel=1e-3)


def test_meridians_climb_a_ball():
    ball = sphere(10.0, 4)
    top = int(np.argmax(ball.vertices[:, 2]))
    for start in np.flatnonzero(np.abs(ball.vertices[:, 2] + 6.0) < 0.2)[::7]:
        line = gradient_line(ball, ball.vertices[:, 2], int(start))
        assert line.edges[-1, 0] == top
        x, y = points(ball, line)[:-1, :2].T
        begin = np.arctan2(*ball.vertices[start, 1::-1])
        away = np.hypot(x, y) > 1.0
        turned = np.angle(np.exp(1j * (np.arctan2(y, x) - begin)))[away]
        assert np.abs(turned).max() < 0.08
        angle = np.pi / 2 - np.arcsin(ball.vertices[start, 2] / 10.0)
        assert line.length == pytest.approx(10.0 * angle, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_every_step_rises_within_one_face(seed):
    mesh = noisy(star_shape(3), np.random.default_rng(seed), 1.0)
    values = mesh.vertices @ np.array([0.3, 0.5, 0.8])
    line = gradient_line(mesh, values, int(np.argmin(values)))
    assert (np.diff(along(values, line)) > 0).all()
    faces = {frozenset(f) for f in mesh.faces.tolist()}
    for one, two in zip(line.edges[:-1], line.edges[1:], strict=True):
        assert any({*one.tolist(), *two.tolist()} <= face for face in faces)
    summit = int(line.edges[-1, 0])
    beside = np.unique(mesh.faces[(mesh.faces == summit).any(axis=1)])
    assert values[beside].max() == values[summit]
    again = gradient_line(mesh, values, int(np.argmin(values)))
    assert np.array_equal(again.edges, line.edges)
    assert np.array_equal(again.fraction, line.fraction)
