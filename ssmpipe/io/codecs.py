"""Artifacts in and out of a stage's folder: the only place that knows which kind is stored how."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.contract import Landmarks, ShapeInfo
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.parameterize.seam import Seam
from ssmpipe.io.arrays import read_npz, write_npz
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.io.models import read_model, write_model
from ssmpipe.io.outlines import read_outline, write_outline
from ssmpipe.io.splines import read_spline, write_spline
from ssmpipe.io.statismo import write_statismo
from ssmpipe.io.tables import read_table, read_text, write_table

_SAFE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
_CORRESPONDENCE_ARRAYS = (
    "points", "points_scan", "initial_points", "initial_points_scan", "transform", "scale", "parameters", "faces",
    "description_length", "eigenvalues_initial", "eigenvalues", "coefficients",
)  # fmt: skip


def save_artifact(kind: str, slot: str, obj: Any, folder: Path) -> list[str]:
    """Write an artifact into an existing folder.

    Parameters
    ----------
    kind : str
        ``trimesh outline landmarks transform info seam uv samples surface correspondence model table json meshes arrays``.
    slot : str
        Its name in the chain; the file is named after it.
    obj : object
        As the table in :mod:`ssmpipe.contract` says.
    folder : Path

    Returns
    -------
    list of str
        File names in ``folder``; the same artifact gives the same bytes.

    Raises
    ------
    ArtifactError
        If the kind is unknown or the object is not of it.
    """
    save, _ = _codec(kind)
    _safe(slot)
    return save(slot, obj, folder)


def load_artifact(kind: str, slot: str, folder: Path, files: Sequence[str]) -> Any:
    """Read an artifact that :func:`save_artifact` wrote; ``files`` is what it returned.

    Raises
    ------
    ArtifactError
        If a file is missing, cannot be read, or lies outside ``folder``; names the file.
    """
    _, load = _codec(kind)
    paths = [folder / name for name in files]
    for name, path in zip(files, paths, strict=True):
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ArtifactError(f"'{name}' lies outside its folder")
        if not path.is_file():
            raise ArtifactError(f"{name} ({kind} '{slot}') is missing", "run the stage again that makes it")
    try:
        return load(paths)
    except ArtifactError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise ArtifactError(f"{', '.join(files)} is not a readable {kind} ({text})", "run the stage again") from error


def to_plain(value: Any) -> Any:
    """Turn numpy scalars and arrays, tuples and mappings into what JSON can hold; NaN and infinities become null.

    Examples
    --------
    >>> to_plain({"a": np.float64(1.5), "b": np.arange(2), "c": (float("nan"),)})
    {'a': 1.5, 'b': [0, 1], 'c': [None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path, value: Any) -> None:
    """Write JSON with keys in their order and floats with all their digits."""
    text = json.dumps(to_plain(value), indent=1, ensure_ascii=False, allow_nan=False)
    path.write_bytes((text + "\n").encode())


def read_json(path: Path) -> Any:
    """Read JSON; an unreadable file is an ArtifactError that names it."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path.name} is not readable JSON ({str(error)[:100]})", "run the stage again") from error


def _safe(name: str) -> str:
    if not _SAFE.fullmatch(name):
        raise ArtifactError(f"'{name[:60]}' cannot be a file name", "use letters, digits, '_', '-' and '.'")
    return name


def _save_trimesh(slot: str, obj: Any, folder: Path) -> list[str]:
    write_mesh(folder / f"{slot}.ply", obj)
    return [f"{slot}.ply"]


def _load_trimesh(paths: list[Path]) -> Any:
    return read_mesh(paths[0])


def _save_meshes(slot: str, obj: Any, folder: Path) -> list[str]:
    files = []
    for name in sorted(obj):
        save = _save_outline if isinstance(obj[name], Outline) else _save_trimesh
        files += save(_safe(name), obj[name], folder)
    return files


def _load_meshes(paths: list[Path]) -> Any:
    return {path.name[:-4]: read_outline(path) if path.suffix == ".csv" else read_mesh(path) for path in paths}


def _save_outline(slot: str, obj: Any, folder: Path) -> list[str]:
    write_outline(folder / f"{slot}.csv", obj)
    return [f"{slot}.csv"]


def _load_outline(paths: list[Path]) -> Any:
    return read_outline(paths[0])


def _save_landmarks(slot: str, obj: Landmarks, folder: Path) -> list[str]:
    write_json(folder / f"{slot}.json", {"points": obj.points, "roles": obj.roles})
    return [f"{slot}.json"]


def _load_landmarks(paths: list[Path]) -> Landmarks:
    content = read_json(paths[0])
    return Landmarks({k: np.array(p, dtype=np.float64) for k, p in content["points"].items()}, dict(content["roles"]))


def _save_transform(slot: str, obj: Any, folder: Path) -> list[str]:
    matrix = np.asarray(obj, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ArtifactError(f"'{slot}' is not a finite 4 x 4 matrix but of shape {matrix.shape}")
    write_json(folder / f"{slot}.json", matrix)
    return [f"{slot}.json"]


def _load_transform(paths: list[Path]) -> Any:
    matrix = np.array(read_json(paths[0]), dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ArtifactError(f"{paths[0].name} is not a finite 4 x 4 matrix", "run the stage again")
    return matrix


def _save_info(slot: str, obj: ShapeInfo, folder: Path) -> list[str]:
    write_json(folder / f"{slot}.json", {"id": obj.id, "side": obj.side, "columns": obj.columns})
    return [f"{slot}.json"]


def _load_info(paths: list[Path]) -> ShapeInfo:
    content = read_json(paths[0])
    return ShapeInfo(content["id"], content["side"], dict(content["columns"]))


def _array_codec(name: str) -> tuple[Callable[..., list[str]], Callable[..., Any]]:
    def save(slot: str, obj: Any, folder: Path) -> list[str]:
        write_npz(folder / f"{slot}.npz", {name: np.asarray(obj, dtype=np.float64)})
        return [f"{slot}.npz"]

    def load(paths: list[Path]) -> Any:
        return read_npz(paths[0], (name,))[name]

    return save, load


def _save_seam(slot: str, obj: Seam, folder: Path) -> list[str]:
    poles = np.array(obj.poles, dtype=np.int64)
    write_npz(folder / f"{slot}.npz", {"topology": np.array(obj.topology), "pairs": obj.pairs, "poles": poles})
    return [f"{slot}.npz"]


def _load_seam(paths: list[Path]) -> Seam:
    arrays = read_npz(paths[0], ("topology", "pairs", "poles"))
    return Seam(str(arrays["topology"]), arrays["pairs"], tuple(arrays["poles"].tolist()))  # type: ignore[arg-type]


def _save_surface(slot: str, obj: Any, folder: Path) -> list[str]:
    write_spline(folder / f"{slot}.npz", obj)
    return [f"{slot}.npz"]


def _load_surface(paths: list[Path]) -> Any:
    return read_spline(paths[0])


def _save_correspondence(slot: str, obj: Correspondence, folder: Path) -> list[str]:
    arrays: dict[str, Any] = {"ids": np.array(obj.ids, dtype=np.str_)}
    arrays.update((name, getattr(obj, name)) for name in _CORRESPONDENCE_ARRAYS)
    arrays["grid"] = np.array(obj.grid, dtype=np.int64)
    arrays["topology"] = np.array(obj.topology)
    arrays["reference"] = np.array(obj.reference, dtype=np.int64)
    arrays["lambda_cut"] = np.array(obj.lambda_cut, dtype=np.float64)
    if obj.window is not None:
        arrays["window"] = np.array([obj.window.low, obj.window.high])
    if obj.normals is not None:
        arrays["normals"], arrays["normal_scale"] = obj.normals, np.array(obj.normal_scale)
    write_npz(folder / f"{slot}.npz", arrays)
    return [f"{slot}.npz"]


def _load_correspondence(paths: list[Path]) -> Correspondence:
    arrays = read_npz(paths[0], ("ids", "grid", "topology", "reference", "lambda_cut", *_CORRESPONDENCE_ARRAYS))
    return Correspondence(
        ids=tuple(arrays["ids"].tolist()),
        grid=tuple(arrays["grid"].tolist()),
        topology=str(arrays["topology"]),
        reference=int(arrays["reference"]),
        lambda_cut=float(arrays["lambda_cut"]),
        window=Window(*map(tuple, arrays["window"].tolist())) if "window" in arrays else None,
        normals=arrays.get("normals"),
        normal_scale=float(arrays.get("normal_scale", 0.0)),
        **{name: arrays[name] for name in _CORRESPONDENCE_ARRAYS},
    )


def _save_model(slot: str, obj: ShapeModel, folder: Path) -> list[str]:
    write_model(folder / f"{slot}.npz", obj)
    write_statismo(folder / f"{slot}.h5", obj)
    return [f"{slot}.npz", f"{slot}.h5"]


def _load_model(paths: list[Path]) -> ShapeModel:
    return read_model(next(p for p in paths if p.suffix == ".npz"))


def _save_table(slot: str, obj: Any, folder: Path) -> list[str]:
    write_table(folder / f"{slot}.csv", obj)
    return [f"{slot}.csv"]


def _load_table(paths: list[Path]) -> Any:
    return read_table(paths[0])


def _save_arrays(slot: str, obj: Any, folder: Path) -> list[str]:
    write_npz(folder / f"{slot}.npz", obj)
    return [f"{slot}.npz"]


def _load_arrays(paths: list[Path]) -> Any:
    return read_npz(paths[0])


def _save_json(slot: str, obj: Any, folder: Path) -> list[str]:
    write_json(folder / f"{slot}.json", obj)
    return [f"{slot}.json"]


def _load_json(paths: list[Path]) -> Any:
    return read_json(paths[0])


_CODECS: dict[str, tuple[Callable[..., list[str]], Callable[..., Any]]] = {
    "trimesh": (_save_trimesh, _load_trimesh),
    "outline": (_save_outline, _load_outline),
    "landmarks": (_save_landmarks, _load_landmarks),
    "transform": (_save_transform, _load_transform),
    "info": (_save_info, _load_info),
    "seam": (_save_seam, _load_seam),
    "uv": _array_codec("uv"),
    "samples": _array_codec("samples"),
    "surface": (_save_surface, _load_surface),
    "correspondence": (_save_correspondence, _load_correspondence),
    "model": (_save_model, _load_model),
    "table": (_save_table, _load_table),
    "json": (_save_json, _load_json),
    "meshes": (_save_meshes, _load_meshes),
    "arrays": (_save_arrays, _load_arrays),
}

KINDS = tuple(_CODECS)
"""Kinds of artifacts that can be stored."""


def _codec(kind: str) -> tuple[Callable[..., list[str]], Callable[..., Any]]:
    if kind not in _CODECS:
        raise ArtifactError(f"unknown kind of artifact '{kind}'", f"one of {' '.join(KINDS)}")
    return _CODECS[kind]
