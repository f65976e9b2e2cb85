"""Where outlines begin and end."""

from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.ends import between, contains, cut_stem, inscribed_circle
from ssmpipe.core.outline.outline import Outline

SQUARE = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])


def spoon(handle: float, width: float = 1.0, *, closed: bool = False) -> Outline:
    """A disk of radius 2 on a handle that points down; open at its lower end."""
    turn = np.arcsin(0.5 * width / 2)
    t = np.linspace(-np.pi / 2 + turn, 1.5 * np.pi - turn, 400)
    disk = 2 * np.column_stack([np.cos(t), np.sin(t)])
    ends = np.array([[0.5 * width, -handle], [-0.5 * width, -handle]])
    return Outline(np.concatenate([ends[:1], disk, ends[1:]]), closed)


def test_between_two_points_of_a_closed_outline_the_longer_way_is_taken() -> None:
    for ring in (SQUARE, SQUARE[::-1], np.roll(SQUARE, 2, axis=0)):
        part = between(Outline(ring, True), np.array([1.0, -1]), np.array([3.0, -1]))
        assert not part.closed
        assert part.points[0].tolist() == [1, 0]
        assert part.points[-1].tolist() == [3, 0]
        assert part.length == pytest.approx(14)
    with pytest.raises(GeometryError, match="same point"):
        between(Outline(SQUARE, True), np.array([1.0, -1]), np.array([1.0, -2]))


def test_an_open_outline_is_shortened_and_turned() -> None:
    line = Outline(SQUARE, False)
    assert between(line, np.array([1.0, 0]), np.array([2.0, 4])).points.tolist() == [[1, 0], [4, 0], [4, 4], [2, 4]]
    assert between(line, np.array([2.0, 4]), np.array([1.0, 0])).points.tolist() == [[2, 4], [4, 4], [4, 0], [1, 0]]
    whole = between(line, SQUARE[0], SQUARE[-1])
    np.testing.assert_array_equal(whole.points, SQUARE)


def test_the_inscribed_circle_of_a_triangle() -> None:
    center, radius = inscribed_circle(Outline(np.array([[0, 0], [4, 0], [0, 3.0]]), True))
    np.testing.assert_allclose([*center, radius], [1, 1, 1], atol=5e-3)
    flat = Outline(np.array([[0, 0], [1, 0], [2, 0], [1, 0.0]]), True)
    with pytest.raises(GeometryError, match="encloses no area"):
        inscribed_circle(flat)


def test_inside_and_outside() -> None:
    points = np.random.default_rng(0).uniform(-1, 5, size=(500, 2))
    assert np.array_equal(contains(SQUARE, points), ((points > 0) & (points < 4)).all(axis=1))


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("width", [1.7, 3.0])
def test_the_stem_is_cut_at_the_same_place_however_long_it_is(closed: bool, width: float) -> None:
    cuts = []
    for handle in (4.0, 5.0, 6.5):
        whole = spoon(handle, width, closed=closed)
        for outline, sign in ((whole, 1.0), (Outline(whole.points[::-1], closed), -1.0)):
            part = cut_stem(outline, 1.6)
            assert not part.closed
            assert part.points[0, 0] * sign > 0, "runs like the given one"
            assert part.points[:, 1].max() == pytest.approx(2, abs=1e-3)
            cuts.append(np.abs(part.points[[0, -1]]))
    np.testing.assert_allclose(cuts, np.broadcast_to(cuts[0], np.shape(cuts)), atol=0.03)
    assert np.hypot(*cuts[0][0]) == pytest.approx(1.6 * 2, abs=0.05)


def test_no_stem_or_too_short_a_one_is_refused() -> None:
    with pytest.raises(GeometryError, match="no stem crosses"):
        cut_stem(spoon(2.6, 1.7), 1.6)
    with pytest.raises(GeometryError, match=r"ends within 1\.6 times"):
        cut_stem(Outline(np.concatenate([spoon(5.0, 3.0).points[:-1], [[-1.5, -2.0]]]), False), 1.6)
    t = 2 * np.pi * np.arange(200) / 200
    disk = Outline(np.column_stack([np.cos(t), np.sin(t)]), True)
    with pytest.raises(GeometryError, match="no stem"):
        cut_stem(disk)
    with pytest.raises(GeometryError, match="no stem wider"):
        cut_stem(spoon(6.0, 1.0), 1.6)
