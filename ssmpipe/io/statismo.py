"""Shape models in the HDF5 layout of statismo 0.9, which Scalismo reads too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np

from ssmpipe.core.model.shape_model import ShapeModel


def write_statismo(path: Path, model: ShapeModel) -> None:
    """Write a model as HDF5; the same model gives the same bytes (no time stamps).

    The layout stores float32: mean as absolute coordinates, orthonormal basis (3 n_P, n_modes), variances with divisor
    n_S - 1, scores in standard deviations. Plane shapes get z = 0; curves become a line mesh.
    """
    n_points, dimension = model.mean.shape
    n_modes = len(model.variances)
    mean = np.zeros((n_points, 3))
    mean[:, :dimension] = model.mean
    basis = np.zeros((n_modes, n_points, 3))
    basis[:, :, :dimension] = model.modes
    cells = model.faces.T if len(model.faces) else _segments(n_points, model.topology == "curve-closed")
    with h5py.File(path, "w", libver=("earliest", "v110"), track_order=False) as file:
        _put(file, "version/majorVersion", np.int32(0))
        _put(file, "version/minorVersion", np.int32(9))
        representer = file.create_group("representer")
        kind = "POLYGON_MESH" if len(model.faces) else "LINE_MESH"
        for key, text in (("name", "vtkStandardMeshRepresenter"), ("version", "1.0"), ("datasetType", kind)):
            representer.attrs.create(key, np.bytes_(text))
        _put(file, "representer/points", mean.T.astype(np.float32))
        _put(file, "representer/cells", cells.astype(np.int32))
        file.create_group("representer/pointData")
        file.create_group("representer/cellData")
        _put(file, "model/mean", mean.reshape(-1).astype(np.float32))
        _put(file, "model/pcaBasis", basis.reshape(n_modes, -1).T.astype(np.float32))
        _put(file, "model/pcaVariance", model.variances.astype(np.float32))
        _put(file, "model/noiseVariance", np.float32(0))
        _put(file, "modelinfo/build-time", np.bytes_("not recorded"))
        _put(file, "modelinfo/scores", model.scores.T.astype(np.float32))
        _put(file, "modelinfo/modelBuilder-0/builderName", np.bytes_("ssmpipe"))
        _put(file, "modelinfo/modelBuilder-0/buildTime", np.bytes_("not recorded"))
        for i, shape_id in enumerate(model.ids):
            _put(file, f"modelinfo/modelBuilder-0/dataInfo/URI_{i}", np.bytes_(shape_id.encode()))
        file.create_group("modelinfo/modelBuilder-0/parameters")


def _segments(n_points: int, closed: bool) -> np.ndarray:
    start = np.arange(n_points if closed else n_points - 1)
    return np.stack([start, (start + 1) % n_points])


def _put(file: h5py.File, name: str, value: Any) -> None:
    file.create_dataset(name, data=np.ascontiguousarray(value) if np.ndim(value) else value, track_times=False)
