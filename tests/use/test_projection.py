from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.use.projection import Projection
from tests.support.small_run import grid_faces


def test_what_the_model_does_not_cover_is_no_distance() -> None:
    """A scan three times as long as the model, 1 mm above it; only where the rims are free does the rest not count."""

    def plate(width: int, height: float) -> TriMesh:
        x, y = np.meshgrid(np.arange(width + 1.0), np.arange(5.0), indexing="ij")
        return TriMesh(np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3), grid_faces(width + 1, 5))

    model, scan = plate(4, 0.0), plate(12, 1.0)

    def of(window: Window | None) -> Projection:
        target = SimpleNamespace(model=SimpleNamespace(window=window, faces=model.faces, topology="disk"))
        return Projection(
            cast(Any, target), model.vertices, *np.zeros((3, 1)), model.vertices, np.eye(4), scan, cast(Any, None)
        )

    free, kept = of(Window((0.0, 0.0), (1.0, 0.5))), of(None)
    assert kept.covered().all()
    assert np.abs(kept.distances()[1]).max() > 8
    inside = (scan.vertices[:, 0] < 4) & (np.abs(scan.vertices[:, 1] - 2) < 2)
    assert free.covered()[inside & (scan.vertices[:, 0] > 0)].all()
    assert not free.covered()[scan.vertices[:, 0] > 4].any()
    assert np.abs(free.distances()[1]).max() == pytest.approx(1)
