"""``model.npz``: everything of a shape model, with a version of the layout and a way up from older ones.

========  ==========================================================================================
version   what changed
========  ==========================================================================================
1         no version number in the file; mean, modes, variances, scores, grid, faces, topology, ids
2         ``format_version``; ``lambda_cut``; ``chain`` (JSON text) and what its steps had in common
3         ``window``: (2, d_par) part of the domain that it covers where rims were free, else (0, 0)
4         ``normals``: (n_S, n_P, d) of the training points, else (0, 0, 0); ``normal_scale`` [mm]
========  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import Chain, ShapeModel
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.arrays import read_npz, write_npz

FORMAT = 4
"""Version of the layout that is written."""
_NUMBERS = ("mean", "modes", "variances", "scores", "faces")
_PREPARED = "prepared/"


def write_model(path: Path, model: ShapeModel) -> None:
    """Write a model; the same model gives the same bytes."""
    arrays: dict[str, Any] = {
        "format_version": np.array(FORMAT, dtype=np.int64),
        "ids": np.array(model.ids, dtype=np.str_),
        **{name: getattr(model, name) for name in _NUMBERS},
        "grid": np.array(model.grid, dtype=np.int64),
        "topology": np.array(model.topology),
        "lambda_cut": np.array(model.lambda_cut, dtype=np.float64),
        "window": np.array([model.window.low, model.window.high] if model.window is not None else np.empty((0, 0))),
        "normals": np.empty((0, 0, 0)) if model.normals is None else model.normals,
        "normal_scale": np.array(model.normal_scale, dtype=np.float64),
        "chain": np.array("" if model.chain is None else model.chain.text),
    }
    for name, common in sorted(model.chain.prepared.items()) if model.chain is not None else ():
        if isinstance(common, Outline):
            arrays[f"{_PREPARED}{name}/points"] = common.points
            arrays[f"{_PREPARED}{name}/closed"] = np.array(common.closed)
        else:
            arrays[f"{_PREPARED}{name}/vertices"] = common.vertices
            arrays[f"{_PREPARED}{name}/faces"] = common.faces
    write_npz(path, arrays)


def read_model(path: Path) -> ShapeModel:
    """Read a model of this version or an older one.

    Raises
    ------
    ArtifactError
        If it is no such file, a newer version wrote it, or an array is missing or does not fit the others.
    """
    arrays: dict[str, Any] = read_npz(path)
    version = int(arrays["format_version"]) if "format_version" in arrays else 1
    if not 1 <= version <= FORMAT:
        raise ArtifactError(
            f"{path.name} has the format version {version}, this ssmpipe reads up to {FORMAT}", "update ssmpipe"
        )
    for older in range(version, FORMAT):
        arrays = _UPGRADES[older](arrays)
    wanted = ("ids", *_NUMBERS, "grid", "topology", "lambda_cut", "window", "normals", "normal_scale", "chain")
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise ArtifactError(f"{path.name} has no array {', '.join(missing)}", "build the model again")
    model = ShapeModel(
        ids=tuple(arrays["ids"].tolist()),
        grid=tuple(arrays["grid"].tolist()),
        topology=str(arrays["topology"]),
        lambda_cut=float(arrays["lambda_cut"]),
        window=_window(arrays["window"], path.name),
        normals=arrays["normals"] if arrays["normals"].size else None,
        normal_scale=float(arrays["normal_scale"]),
        chain=_chain(arrays),
        **{name: arrays[name] for name in _NUMBERS},
    )
    n_modes, n_shapes = len(model.variances), len(model.ids)
    fits = (
        model.mean.ndim == 2
        and model.modes.shape == (n_modes, *model.mean.shape)
        and model.scores.shape == (n_shapes, n_modes)
        and int(np.prod(model.grid)) == len(model.mean)
        and (model.normals is None or model.normals.shape == (n_shapes, *model.mean.shape))
        and (model.normals is None or bool(np.isfinite(model.normals).all()))
        and all(np.isfinite(getattr(model, name)).all() for name in _NUMBERS)
    )
    if not fits:
        raise ArtifactError(f"{path.name}: its arrays do not fit each other", "build the model again")
    return model


def _window(array: Any, name: str) -> Window | None:
    if not array.size:
        return None
    try:
        low, high = array.tolist()
        return Window(tuple(map(float, low)), tuple(map(float, high)))
    except (GeometryError, TypeError, ValueError) as error:
        raise ArtifactError(
            f"{name}: its window is no part of the parameter domain", "build the model again"
        ) from error


def _chain(arrays: Mapping[str, Any]) -> Chain | None:
    text = str(arrays["chain"])
    if not text:
        return None
    names = sorted({key.removeprefix(_PREPARED).rsplit("/", 1)[0] for key in arrays if key.startswith(_PREPARED)})
    prepared: dict[str, TriMesh | Outline] = {}
    for name in names:
        part = {key.rsplit("/", 1)[1]: value for key, value in arrays.items() if key.startswith(f"{_PREPARED}{name}/")}
        if "points" in part:
            prepared[name] = Outline(part["points"], bool(part["closed"]))
        else:
            prepared[name] = TriMesh(part["vertices"], part["faces"])
    return Chain(text, prepared)


def _from_1(arrays: dict[str, Any]) -> dict[str, Any]:
    return {**arrays, "lambda_cut": np.array(np.nan), "chain": np.array("")}


def _from_2(arrays: dict[str, Any]) -> dict[str, Any]:
    return {**arrays, "window": np.empty((0, 0))}


def _from_3(arrays: dict[str, Any]) -> dict[str, Any]:
    return {**arrays, "normals": np.empty((0, 0, 0)), "normal_scale": np.array(0.0)}


_UPGRADES: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: _from_1, 2: _from_2, 3: _from_3}
"""From a version to the next one."""
