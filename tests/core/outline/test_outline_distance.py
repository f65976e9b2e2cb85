from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import edge_indices

RNG = np.random.default_rng(8)


def slow(points: np.ndarray, vertices: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Segment by segment, without any search."""
    best = np.full(len(points), np.inf)
    for i, j in edges:
        along = vertices[j] - vertices[i]
        t = np.clip((points - vertices[i]) @ along / max(along @ along, 1e-300), 0, 1)
        distance = np.linalg.norm(points - vertices[i] - t[:, None] * along, axis=1)
        best = np.minimum(best, distance)
    return best


def circle(n: int) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def uneven() -> np.ndarray:
    # one long segment among many short ones: its middle is far from most of it
    return np.concatenate([circle(200), [[9.0, 0.01]], [[9.0, 0.3]]])


@pytest.mark.parametrize("vertices", [circle(300), uneven(), RNG.normal(size=(120, 3)), circle(20)])
def test_the_nearest_place_on_any_polyline(vertices: np.ndarray) -> None:
    edges = edge_indices(len(vertices), True)
    spread = np.concatenate([RNG.normal(0, 2, (400, vertices.shape[1])), vertices[:40]])
    distance, edge, weights = point_to_segments(spread, vertices, edges)
    expected = slow(spread, vertices, edges)
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    place = (weights[:, :, None] * vertices[edges[edge]]).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(place - spread, axis=1), expected, atol=1e-12)
