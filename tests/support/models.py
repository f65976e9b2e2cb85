"""Small shape models of every topology, and the files that hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.io.codecs import save_artifact


def grid_points(topology: str, n_u: int, n_v: int) -> Floats:
    """A plane, a cylinder, a hemisphere or a sphere over the grid of its topology, outward oriented."""
    if topology == "disk":
        u, v = np.meshgrid(np.linspace(0, 20, n_u), np.linspace(0, 30, n_v), indexing="ij")
        return np.stack([u, v, 0.01 * u * v], axis=-1).reshape(-1, 3)
    u, v = np.meshgrid(2 * np.pi * np.arange(n_u) / n_u, np.linspace(0, 1, n_v), indexing="ij")
    if topology == "tube":
        return np.stack([10 * np.cos(u), 10 * np.sin(u), 30 * v], axis=-1).reshape(-1, 3)
    angle = np.pi / 2 * v if topology == "cone" else np.pi * (v - 0.5)
    points = 10 * np.stack([np.cos(angle) * np.cos(u), np.cos(angle) * np.sin(u), np.sin(angle)], axis=-1)
    points[:, -1] = [0, 0, 10]
    if topology == "closed":
        points[:, 0] = [0, 0, -10]
    return points.reshape(-1, 3)


def shape_model(topology: str = "disk", n_u: int = 12, n_v: int = 9, n_shapes: int = 6) -> ShapeModel:
    """A model of stretched copies of one surface."""
    base = grid_points(topology, n_u, n_v)
    stretch = 1 + 0.1 * np.random.default_rng(0).normal(size=(n_shapes, 1, 3))
    mean, modes, variances, scores = principal_components(base * stretch)
    return ShapeModel(
        ids=tuple(f"s{i}" for i in range(n_shapes)),
        mean=mean,
        modes=modes,
        variances=variances,
        scores=scores,
        grid=(n_u, n_v),
        faces=grid_faces(n_u, n_v, periodic_u=topology != "disk"),
        topology=topology,
    )


def curve_model(n_shapes: int = 5) -> ShapeModel:
    """A model of closed planar curves."""
    t = 2 * np.pi * np.arange(20) / 20
    base = np.stack([np.cos(t), np.sin(t)], axis=-1)
    stretch = 1 + 0.1 * np.random.default_rng(0).normal(size=(n_shapes, 1, 2))
    mean, modes, variances, scores = principal_components(base * stretch)
    ids = tuple(f"s{i}" for i in range(n_shapes))
    return ShapeModel(ids, mean, modes, variances, scores, (20,), np.empty((0, 3), dtype=np.int64), "curve-closed")


def write_model(model: ShapeModel, out: Path) -> Path:
    """Store a model as a run does; return the result folder."""
    folder = out / "cohort" / "model"
    folder.mkdir(parents=True)
    save_artifact("model", "model", model, folder)
    return out
