"""Result folders of grouped cohorts, as a run leaves them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.io.tables import write_table
from tests.support.models import grid_points, write_model


def grouped_points(topology: str = "tube", n: int = 16, bump: float = 1.5, seed: int = 0) -> Floats:
    """Surfaces of which the second half has a bump around one point, of random size otherwise."""
    rng = np.random.default_rng(seed)
    base = grid_points(topology, 12, 9)
    outward = base - base.mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    at = base[4 * 9 + 4]
    height = bump * np.exp(-((base - at) ** 2).sum(axis=1) / (2 * 4.0**2))
    ill = (np.arange(n) >= n // 2)[:, None, None]
    stretch = 1 + 0.03 * rng.normal(size=(n, 1, 3))
    return base * stretch + 0.1 * rng.normal(size=(n, 1, 3)) * outward + ill * height[:, None] * outward


def write_groups(out: Path, points: Floats, columns: Mapping[str, Sequence[str]], topology: str = "tube") -> Path:
    """Store a model of ``points`` with the columns of a cohort table beside its scores."""
    mean, modes, variances, scores = principal_components(points)
    ids = tuple(f"p{i:02d}" for i in range(len(points)))
    if topology.startswith("curve"):
        grid: tuple[int, ...] = (len(mean),)
        faces = np.empty((0, 3), dtype=np.int64)
    else:
        grid, faces = (12, 9), grid_faces(12, 9, periodic_u=topology != "disk")
    write_model(ShapeModel(ids, mean, modes, variances, scores, grid, faces, topology), out)
    table = {"id": list(ids), "mode_01": scores[:, 0].tolist()} | {k: list(v) for k, v in columns.items()}
    write_table(out / "cohort/model/scores.csv", Table(table, "scores"))
    return out
