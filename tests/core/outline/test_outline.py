"""Laws of planar outlines: measures, resampling, starting points, alignment."""

from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.align import align_outline, medoid_outline, move_outline
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, crossings, points_at, resample, start_at, without_repeats


def blob(n: int = 300, seed: int = 0, scale: float = 1.0) -> Outline:
    rng = np.random.default_rng(seed)
    t = 2 * np.pi * np.arange(n) / n
    r = 10 + sum(rng.normal(0, 1.5 / k) * np.cos(k * t + rng.uniform(0, 6)) for k in range(1, 6))
    return Outline(scale * np.column_stack([r * np.cos(t), r * np.sin(t)]), True)


def motion(angle: float, dx: float, dy: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:2, 3] = dx, dy
    return matrix


def test_measures_of_a_circle():
    t = 2 * np.pi * np.arange(2000) / 2000
    circle = Outline(np.column_stack([3 * np.cos(t), 3 * np.sin(t)]) + 100, True)
    assert circle.length == pytest.approx(6 * np.pi, rel=1e-5)
    assert circle.signed_area == pytest.approx(9 * np.pi, rel=1e-5)
    assert Outline(circle.points[::-1], True).signed_area == pytest.approx(-9 * np.pi, rel=1e-5)


def test_resampling_is_even_and_lies_on_the_outline():
    outline = blob()
    even = resample(outline, 77)
    assert point_to_segments(even.points, outline.points, outline.edges)[0].max() < 1e-12
    steps = even.steps
    assert steps.std() / steps.mean() < 1e-3
    half = Outline(outline.points[:150], False)
    np.testing.assert_allclose(resample(half, 20).points[[0, -1]], half.points[[0, -1]], atol=1e-12)


def test_moving_the_start_keeps_the_polyline():
    outline = blob(40)
    for length in (0.0, 7.123, outline.length - 0.1, outline.length + 5.0):
        moved = start_at(outline, length)
        np.testing.assert_allclose(moved.points[0], points_at(outline, np.array([length]))[0], atol=1e-9)
        assert moved.length == pytest.approx(outline.length)
        assert moved.signed_area == pytest.approx(outline.signed_area)
    assert len(start_at(outline, outline.steps[:3].sum()).points) == 40
    with pytest.raises(GeometryError, match="open"):
        start_at(Outline(outline.points, False), 1.0)


def test_alignment_undoes_a_motion_and_finds_the_start():
    target = blob()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        begun = start_at(target, rng.uniform(0, target.length))
        moved = move_outline(begun, motion(rng.uniform(-3, 3), *rng.normal(size=2) * 50))
        fit = align_outline(moved, target, n=512)
        back = start_at(move_outline(moved, fit.matrix), fit.start)
        assert fit.rms < 0.05
        assert np.linalg.norm(back.points[0] - target.points[0]) < target.length / 512
        assert np.linalg.det(fit.matrix[:3, :3]) == pytest.approx(1.0)
        kept = align_outline(moved, target, n=512, keep_start=True)
        assert kept.start == 0.0
        assert kept.rms > 10 * fit.rms


def test_alignment_never_reflects_nor_scales():
    target = blob(seed=4)
    mirrored = Outline((target.points * [-1, 1])[::-1], True)
    fit = align_outline(mirrored, target)
    assert np.linalg.det(fit.matrix[:3, :3]) == pytest.approx(1.0)
    assert fit.rms > 0.3
    assert align_outline(blob(seed=4, scale=2.0), target).rms > 5.0


def test_open_outlines_align_end_to_end():
    curve = Outline(blob().points[:120], False)
    moved = move_outline(curve, motion(2.0, 5.0, -3.0))
    fit = align_outline(moved, curve)
    np.testing.assert_allclose(move_outline(moved, fit.matrix).points, curve.points, atol=1e-9)
    assert fit.start == 0.0


def test_the_brute_force_over_all_starts_agrees():
    moving, target = blob(seed=1), blob(seed=2)
    best = min(
        align_outline(start_at(moving, k * moving.length / 64), target, n=64, keep_start=True).rms for k in range(64)
    )
    assert align_outline(moving, target, n=64).rms == pytest.approx(best, rel=1e-6)


def test_medoid_is_the_middle_one():
    shapes = {f"s{k}": blob(seed=3, scale=1 + 0.1 * k) for k in range(5)}
    assert medoid_outline(shapes) == "s2"
    assert medoid_outline(shapes, keep_start=True) == "s2"


def test_repeats_and_crossings():
    points = np.array([[0, 0], [0, 0], [1, 0], [1, 1], [1, 1], [0, 0.0]])
    assert len(without_repeats(Outline(points, True)).points) == 3
    assert len(crossings(blob())) == 0
    tangled = blob().points.copy()
    tangled[[10, 60]] = tangled[[60, 10]]
    assert len(crossings(Outline(tangled, True))) > 0


def test_distance_to_segments_is_that_of_a_dense_sampling():
    outline = blob(30)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 2)) * 12
    distance, edge, weights = point_to_segments(points, outline.points, outline.edges)
    dense = resample(outline, 20000).points
    np.testing.assert_allclose(distance, np.sqrt(((points[:, None] - dense) ** 2).sum(-1)).min(axis=1), atol=1e-3)
    foot = np.einsum("mk,mkd->md", weights, outline.points[outline.edges[edge]])
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), distance)
