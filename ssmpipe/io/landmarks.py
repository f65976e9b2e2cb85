"""Landmark files of many programs, read into one table.

Slicer files state their frame. Scans are taken to be in LPS, the frame of DICOM and of the model files that Slicer has
written since version 4.11, so points in RAS have the signs of x and y changed. ``.fcsv`` without a header line for the
frame comes from old versions and is RAS; ``.mrk.json`` without one is LPS, as its schema says.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.point_lists import point_names, read_asf, read_pts
from ssmpipe.io.tables import read_rows, read_text, text_lines

_NOT_PLACED = ("", "na", "nan", "n/a", "-")
_TABLE = 'write it as {"id": {"name": [x, y, z]}}'
LandmarkTable = dict[str, dict[str, Floats]]

_TO_LPS = {"LPS": (1.0, 1.0, 1.0), "1": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0), "0": (-1.0, -1.0, 1.0)}
_MAX_ELEMENTS = 200_000
_MAX_ELEMENT = 100_000
_MAX_NAME = 200
_FCSV_COLUMNS = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label"]


def read_landmarks(path: Path) -> LandmarkTable:
    """Read named points of one or many shapes.

    Parameters
    ----------
    path : Path
        One table for all: JSON ``{id: {name: [x, y, z]}}`` or long CSV ``id,landmark,x,y[,z]``. One shape each, the id
        being the file's name: Slicer ``.mrk.json`` and ``.fcsv``, MeshLab ``.pp``, a JSON list of
        ``{"id", "coordinates"}``, numbered points ``.asf`` and ``.pts`` (named ``point_01 ...``). Or a folder of such files.

    Returns
    -------
    dict of dict of (3,) or (2,) float64
        By shape id, then by landmark name, in the units of the file. Rows of a CSV file with all coordinates empty (or ``NA``,
        ``NaN``, ``-``) stand for landmarks that were not placed and are left out.

    Raises
    ------
    ArtifactError
        Naming file, shape and landmark.
    """
    path = Path(path)
    if path.is_dir():
        files = [p for p in sorted(path.iterdir()) if p.is_file() and _reader(p) is not None]
        if not files:
            raise ArtifactError(
                f"the folder {path.name} has no landmark files", "supply .json, .csv, .fcsv, .pp, .asf or .pts files"
            )
        table: LandmarkTable = {}
        for file in files:
            for shape_id, points in _read_file(file).items():
                if shape_id in table:
                    raise ArtifactError(
                        f"{path.name}: shape '{shape_id}' occurs again in {file.name}", "remove one of the files"
                    )
                table[shape_id] = points
        return table
    return _read_file(path)


def _reader(path: Path) -> Callable[[Path], LandmarkTable] | None:
    name = path.name.lower()
    readers = {
        ".mrk.json": _read_json, ".json": _read_json, ".fcsv": _read_fcsv, ".csv": _read_csv, ".pp": _read_pp,
        ".asf": _read_numbered, ".pts": _read_numbered,
    }  # fmt: skip
    return next((read for suffix, read in readers.items() if name.endswith(suffix)), None)


def _read_file(path: Path) -> LandmarkTable:
    read = _reader(path)
    if read is None:
        raise ArtifactError(
            f"{path.name}: unknown kind of landmark file", "use .json, .csv, .fcsv, .mrk.json, .pp, .asf or .pts"
        )
    if path.is_file() and path.stat().st_size == 0:
        raise ArtifactError(f"{path.name} is empty", "save the landmarks again")
    return read(path)


def _shape_id(path: Path) -> str:
    name = path.name
    for suffix in (".mrk.json", path.suffix):
        if name.lower().endswith(suffix.lower()):
            return name[: -len(suffix)]
    return name


def _point(coordinates: Any, where: str, signs: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Floats:
    try:
        numbers = [float(c) for c in coordinates if not isinstance(c, bool)]
        if isinstance(coordinates, str | dict) or len(numbers) != len(coordinates):
            raise TypeError
    except (TypeError, ValueError, OverflowError) as error:
        raise ArtifactError(f"{where}: '{str(coordinates)[:60]}' is not a point", "write it as [x, y, z]") from error
    if len(numbers) not in (2, 3):
        raise ArtifactError(
            f"{where}: {len(numbers)} coordinates, need 3 (or 2 for plane curves)", "write it as [x, y, z]"
        )
    if not all(math.isfinite(c) for c in numbers):
        raise ArtifactError(f"{where}: a coordinate is not finite", "remove the landmark where it could not be placed")
    return np.array([s * c + 0.0 for s, c in zip(signs, numbers, strict=False)])


def _add(points: dict[str, Floats], name: Any, point: Floats, where: str) -> None:
    if not isinstance(name, str) or not name.strip():
        raise ArtifactError(f"{where}: a landmark has no name", "name every landmark")
    if len(name) > _MAX_NAME or any(ord(c) < 32 or 0xD800 <= ord(c) < 0xE000 for c in name.strip()):
        raise ArtifactError(
            f"{where}: {ascii(name)[:40]} cannot be the name of a landmark", "give it a short plain name"
        )
    if name.strip() in points:
        raise ArtifactError(f"{where}: landmark '{name.strip()}' occurs twice", "rename or remove one of them")
    points[name.strip()] = point


def _signs(frame: Any, where: str) -> tuple[float, float, float]:
    try:
        return _TO_LPS[str(frame).strip().upper()]
    except KeyError as error:
        raise ArtifactError(
            f"{where}: coordinate system '{str(frame).strip()[:20]}'", "save the points in LPS or RAS"
        ) from error


def _read_json(path: Path) -> LandmarkTable:
    text = read_text(path)
    n_lists = text.count("[") + text.count("{")
    if n_lists > 1000 + len(text) // 8:  # a point with its name takes more than 8 characters
        raise ArtifactError(f"{path.name} has {n_lists} lists in {len(text)} characters, no landmark table", _TABLE)
    try:
        content = json.loads(text, object_pairs_hook=lambda pairs: _once(pairs, path.name))
    except (ValueError, RecursionError) as error:
        raise ArtifactError(
            f"{path.name} is not readable JSON ({str(error)[:100]})", "check it near that place"
        ) from error
    if isinstance(content, dict) and isinstance(content.get("markups"), list):
        return {_shape_id(path): _slicer_points(content["markups"], path)}
    if isinstance(content, list):
        return {_shape_id(path): _list_points(content, path)}
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise ArtifactError(f"{path.name} is not a landmark table", _TABLE)
    table: LandmarkTable = {}
    for shape_id, named in content.items():
        table[shape_id] = {}
        for name, coordinates in named.items():
            point = _point(coordinates, f"{path.name}, shape '{shape_id}', landmark '{name}'")
            _add(table[shape_id], name, point, f"{path.name}, shape '{shape_id}'")
    return table


def _once(pairs: list[tuple[str, Any]], name: str) -> dict[str, Any]:
    """Return a JSON object; a key that occurs twice is refused, since one of its values would be lost."""
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ArtifactError(f"{name}: {ascii(twice)[:60]} occurs twice in one place", "rename or remove one of them")
    return found


def _list_points(items: list[Any], path: Path) -> dict[str, Floats]:
    points: dict[str, Floats] = {}
    for item in items:
        if not isinstance(item, dict) or "id" not in item or "coordinates" not in item:
            raise ArtifactError(f"{path.name} is not a landmark list", 'each entry needs "id" and "coordinates"')
        point = _point(item["coordinates"], f"{path.name}, landmark '{item['id']}'")
        _add(points, item["id"], point, path.name)
    return points


def _slicer_points(markups: list[Any], path: Path) -> dict[str, Floats]:
    points: dict[str, Floats] = {}
    for markup in markups:
        if not isinstance(markup, dict) or not isinstance(markup.get("controlPoints", []), list):
            raise ArtifactError(f"{path.name} is not a Slicer markups file", "save it again from Slicer as .mrk.json")
        signs = _signs(markup.get("coordinateSystem", "LPS"), path.name)
        units = markup.get("coordinateUnits", "mm")
        if units != "mm":
            raise ArtifactError(f"{path.name}: coordinates are in '{str(units)[:20]}'", "save the points in mm")
        for control in markup.get("controlPoints", []):
            if not isinstance(control, dict) or control.get("positionStatus", "defined") != "defined":
                continue
            label = control.get("label")
            point = _point(control.get("position"), f"{path.name}, landmark '{label}'", signs)
            _add(points, label, point, path.name)
    return points


def _read_fcsv(path: Path) -> LandmarkTable:
    signs, columns = _TO_LPS["RAS"], _FCSV_COLUMNS
    points: dict[str, Floats] = {}
    for number, line in enumerate(text_lines(read_text(path)), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            if key.strip().lower() == "coordinatesystem":
                signs = _signs(value, path.name)
            elif key.strip().lower() == "columns":
                columns = [c.strip() for c in value.split(",")]
            continue
        if not line.strip():
            continue
        try:
            row = dict(zip(columns, next(csv.reader([line])), strict=False))
        except csv.Error as error:
            raise ArtifactError(f"{path.name}, line {number}: {error}", "save it again from Slicer") from error
        if not {"x", "y", "z", "label"} <= row.keys():
            raise ArtifactError(f"{path.name}, line {number}: no x, y, z and label", "save it again from Slicer")
        where = f"{path.name}, line {number}, landmark '{row['label']}'"
        _add(points, row["label"], _point([row["x"], row["y"], row["z"]], where, signs), f"{path.name}, line {number}")
    return {_shape_id(path): points}


def _read_csv(path: Path) -> LandmarkTable:
    header, rows = read_rows(path, "id", ("landmark", "x", "y", "z"))
    axes = ["x", "y", "z"] if "z" in header else ["x", "y"]
    missing = [name for name in ("landmark", *axes) if name not in header]
    if missing:
        raise ArtifactError(f"{path.name}: no column {', '.join(missing)}", "the header is id,landmark,x,y,z")
    table: LandmarkTable = {}
    for line, cells in rows:
        row = dict(zip(header, cells, strict=True))
        where = f"{path.name}, line {line}, shape '{row['id']}'"
        if not row["id"]:
            raise ArtifactError(f"{path.name}, line {line}: the id is empty", "give every row a shape id")
        if all(row[axis].lower() in _NOT_PLACED for axis in axes):
            table.setdefault(row["id"], {})
            continue
        point = _point([row[axis] for axis in axes], f"{where}, landmark '{row['landmark']}'")
        _add(table.setdefault(row["id"], {}), row["landmark"], point, where)
    return table


def _read_pp(path: Path) -> LandmarkTable:
    text = read_text(path)
    if "<!ENTITY" in text:
        raise ArtifactError(f"{path.name} defines XML entities", "save it again from MeshLab")
    if text.count("<") > _MAX_ELEMENTS:
        raise ArtifactError(f"{path.name} has more than {_MAX_ELEMENTS} elements", "save it again from MeshLab")
    longest = max((len(part) for part in text.split("<")), default=0)
    if longest > _MAX_ELEMENT:
        raise ArtifactError(f"{path.name} has an element of {longest} characters", "save it again from MeshLab")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ArtifactError(f"{path.name} is not readable XML ({error})", "save it again from MeshLab") from error
    points: dict[str, Floats] = {}
    for point in root.iter("point"):
        if point.get("active", "1") == "0":
            continue
        name = point.get("name")
        coordinates = [point.get(axis) for axis in "xyz"]
        _add(points, name, _point(coordinates, f"{path.name}, landmark '{name}'"), path.name)
    return {_shape_id(path): points}


def _read_numbered(path: Path) -> LandmarkTable:
    points = read_asf(path).points if path.suffix.lower() == ".asf" else read_pts(path)
    return {_shape_id(path): dict(zip(point_names(len(points)), points, strict=True))}
