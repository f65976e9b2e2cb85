"""What the cohorts of scans share: scores, holes that stay manifold, random order."""

from __future__ import annotations

import igl
import numpy as np

from ssmpipe.synth._scans import shuffled, spread_scores, without


def test_sizes_favour_large_modes() -> None:
    draw = {"n": 6, "n_modes": 6, "n_draws": 300}
    plain = spread_scores(**draw, rng=np.random.default_rng(0))
    sized = spread_scores(**draw, rng=np.random.default_rng(0), sizes=np.array([1, 1, 0.1, 0.1, 0.1, 0.1]))
    assert abs(np.corrcoef(sized.T)[0, 1]) < min(0.05, abs(np.corrcoef(plain.T)[0, 1]) + 1e-9)
    assert np.array_equal(np.sort(plain, axis=0), np.sort(sized, axis=0))


def sheet(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(n, dtype=float), np.arange(n, dtype=float), indexing="ij")
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.column_stack([i, i + n, i + n + 1]), np.column_stack([i, i + n + 1, i + 1])])
    return np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces


def test_removal_leaves_no_bow_ties() -> None:
    vertices, faces = sheet()
    removed = np.random.default_rng(0).random(len(vertices)) < 0.15
    left, triangles = without(vertices, faces, removed)
    assert igl.facet_components(triangles)[0] == 1
    loops = np.concatenate(igl.boundary_loop_all(triangles))
    assert len(loops) == len(set(loops.tolist()))
    assert len(np.unique(triangles)) == len(left)
    assert not (left[:, None] == vertices[removed][None]).all(axis=2).any()


def test_shuffling_changes_the_order_and_nothing_else() -> None:
    vertices, faces = sheet(5)
    moved, triangles = shuffled(vertices, faces, np.random.default_rng(0))
    assert not np.array_equal(moved, vertices)

    def area(v: np.ndarray, f: np.ndarray) -> np.ndarray:
        return np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])[:, 2]

    assert (area(moved, triangles) > 0).all()
    assert np.allclose(np.sort(moved[triangles].mean(axis=1), axis=0), np.sort(vertices[faces].mean(axis=1), axis=0))
