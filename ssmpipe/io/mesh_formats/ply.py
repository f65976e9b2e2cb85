"""PLY, ASCII and binary, any element and property order; doubles are kept to the bit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, MAX_CORNERS, to_floats, triangulate

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)  # name, type, type of the list length

    def dtype(self, order: str, lengths: list[int]) -> np.dtype:
        """Return the record type of one row when its lists have these lengths."""
        fields: list[Any] = []
        rest = iter(lengths)
        for name, kind, count_kind in self.properties:
            if count_kind is not None:
                fields.append((f"{name} length", order + count_kind))
                fields.append((name, order + kind, (next(rest),)))
            else:
                fields.append((name, order + kind))
        return np.dtype(fields)

    @property
    def n_lists(self) -> int:
        return sum(count_kind is not None for _, _, count_kind in self.properties)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, 1 << 20)
    newline = data.find(b"\n", end) if end >= 0 else -1
    if newline < 0:
        raise ArtifactError("not a readable PLY: the header has no end (no 'end_header')", EXPORT_AGAIN)
    elements: list[_Element] = []
    order: str | None = None
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = _ORDER[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append((words[2], _TYPES[words[1]], None))
            else:
                raise KeyError(words[0])
        except (KeyError, IndexError, ValueError) as error:
            raise ArtifactError(f"not a readable PLY: header line '{line[:60]}'", EXPORT_AGAIN) from error
    if order is None:
        raise ArtifactError("not a readable PLY: the header has no 'format' line", EXPORT_AGAIN)
    return order, elements, newline + 1


def _check_counts(elements: list[_Element], order: str, n_bytes: int) -> None:
    """Refuse counts that cannot fit into the file before anything is allocated."""
    for element in elements:
        smallest = element.dtype("<", [0] * element.n_lists).itemsize if order else 2 * len(element.properties)
        if element.count < 0 or element.count * max(smallest, 1) > n_bytes + 1:
            raise ArtifactError(
                f"not a readable PLY: the header says {element.count} x '{element.name}', {n_bytes} bytes follow",
                EXPORT_AGAIN,
            )


def _cut(element: _Element) -> ArtifactError:
    return ArtifactError(
        f"truncated PLY: the data end inside the {element.count} rows of '{element.name}' that the header says",
        EXPORT_AGAIN,
    )


def _binary_rows(data: bytes, start: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Return columns by name; a list column is (lengths, flat values)."""
    lengths = _first_lengths(data, start, element, order)
    dtype = element.dtype(order, lengths)
    end = start + dtype.itemsize * element.count
    if end <= len(data) or not element.n_lists:
        if end > len(data):
            raise _cut(element)
        rows = np.frombuffer(data, dtype=dtype, offset=start, count=element.count)
        if _same_lengths(rows, element):
            columns: dict[str, Any] = {}
            for name, _, count_kind in element.properties:
                column = rows[name]
                columns[name] = (
                    column if count_kind is None else (np.full(len(rows), column.shape[1]), column.reshape(-1))
                )
            return columns, end
    return _walk_rows(data, start, element, order)


def _first_lengths(data: bytes, start: int, element: _Element, order: str) -> list[int]:
    lengths: list[int] = []
    if element.count == 0:
        return [0] * element.n_lists
    for _, kind, count_kind in element.properties:
        if count_kind is not None:
            size = np.dtype(order + count_kind)
            if start + size.itemsize > len(data):
                raise _cut(element)
            length = int(np.frombuffer(data, dtype=size, offset=start, count=1)[0])
            lengths.append(length)
            start += size.itemsize
            if length < 0 or start + length * np.dtype(kind).itemsize > len(data):
                raise _cut(element)
            start += length * np.dtype(kind).itemsize
        else:
            start += np.dtype(kind).itemsize
    return lengths


def _same_lengths(rows: np.ndarray, element: _Element) -> bool:
    lists = [name for name, _, count_kind in element.properties if count_kind is not None]
    return all(bool(np.all(rows[f"{name} length"] == rows[name].shape[1])) for name in lists)


def _walk_rows(data: bytes, start: int, element: _Element, order: str) -> tuple[dict[str, Any], int]:
    """Read rows whose lists differ in length: one walk over the lengths, then all values at once."""
    places: dict[str, list[int]] = {name: [] for name, _, _ in element.properties}
    lengths: dict[str, list[int]] = {name: [] for name, _, kind in element.properties if kind is not None}
    endian: Literal["big", "little"] = "big" if order == ">" else "little"
    layout = [
        (name, np.dtype(kind).itemsize, np.dtype(count or "u1").itemsize if count else 0, (count or "").startswith("i"))
        for name, kind, count in element.properties
    ]
    for _ in range(element.count):
        for name, size, count_size, signed in layout:
            if count_size:
                head = data[start : start + count_size]
                length = (
                    head[0] if count_size == 1 and head and not signed else int.from_bytes(head, endian, signed=signed)
                )
                start += count_size
                places[name].append(start)
                if length < 0 or start + length * size > len(data):
                    raise _cut(element)
                lengths[name].append(length)
                start += length * size
            else:
                places[name].append(start)
                start += size
        if start > len(data):
            raise _cut(element)
    columns: dict[str, Any] = {}
    for name, kind, count in element.properties:
        n = np.array(lengths[name], dtype=np.int64) if count is not None else np.ones(element.count, dtype=np.int64)
        values = _gather(data, np.array(places[name], dtype=np.int64), n, np.dtype(order + kind))
        columns[name] = (n, values) if count is not None else values
    return columns, start


def _gather(data: bytes, places: Ints, lengths: Ints, dtype: np.dtype) -> np.ndarray:
    """Return the runs of ``lengths`` numbers that begin at the bytes ``places``, one after the other."""
    raw = np.frombuffer(data, dtype=np.uint8)
    flat = np.empty(int(lengths.sum()), dtype=dtype)
    first = np.cumsum(lengths) - lengths
    for length in np.unique(lengths[lengths > 0]):
        rows = np.flatnonzero(lengths == length)
        for part in np.array_split(rows, 1 + len(rows) * int(length) // 65_536):
            at = places[part][:, None] + np.arange(length * dtype.itemsize)
            flat[first[part][:, None] + np.arange(length)] = raw[at].view(dtype)
    return flat


def _joined(values: dict[str, list[Any]], element: _Element) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name, _, count_kind in element.properties:
        if count_kind is None:
            columns[name] = np.array(values[name])
        else:
            flat = np.concatenate(values[name]) if values[name] else np.zeros(0, dtype=np.int64)
            columns[name] = (np.array([len(v) for v in values[name]], dtype=np.int64), flat)
    return columns


def _ascii_rows(tokens: list[bytes], start: int, element: _Element) -> tuple[dict[str, Any], int]:
    width = len(element.properties)
    if not element.n_lists:
        end = start + width * element.count
        if end > len(tokens):
            raise _cut(element)
        table = to_floats(tokens[start:end], f"'{element.name}'").reshape(element.count, width)
        return {name: table[:, i] for i, (name, _, _) in enumerate(element.properties)}, end
    values: dict[str, list[Any]] = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        for name, _, count_kind in element.properties:
            try:
                if count_kind is None:
                    values[name].append(float(tokens[start]))
                    start += 1
                else:
                    length = int(tokens[start])
                    row = tokens[start + 1 : start + 1 + length]
                    if length > MAX_CORNERS:
                        raise ArtifactError(
                            f"'{element.name}': a list has {length} corners, at most {MAX_CORNERS} are read",
                            "export triangles",
                        )
                    if length < 0 or len(row) != length:
                        raise _cut(element)
                    values[name].append(np.array([float(t) for t in row]))
                    start += 1 + length
            except IndexError as error:
                raise _cut(element) from error
            except ValueError as error:
                raise ArtifactError(f"'{element.name}': not a number ({str(error)[:80]})", EXPORT_AGAIN) from error
    return _joined(values, element), start


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read a PLY file: ``vertex`` x, y, z and ``face`` vertex_indices; all else is skipped.

    Raises
    ------
    ArtifactError
        If the header is not one, its counts do not fit the file, or there is no face element.
    """
    if not data.startswith((b"ply\n", b"ply\r")):
        raise ArtifactError("not a readable PLY: it does not begin with 'ply'", EXPORT_AGAIN)
    order, elements, start = _header(data)
    _check_counts(elements, order, len(data) - start)
    found: dict[str, dict[str, Any]] = {}
    most = sum(e.count * (len(e.properties) + MAX_CORNERS * e.n_lists) for e in elements)
    tokens = [] if order else data[start:].split(maxsplit=min(most, len(data)))
    position = start if order else 0
    for element in elements:
        found[element.name], position = (
            _binary_rows(data, position, element, order) if order else _ascii_rows(tokens, position, element)
        )
        if "vertex" in found and "face" in found:
            break
    try:
        vertices = np.stack([found["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)
    except KeyError as error:
        raise ArtifactError("the PLY has no vertices with x, y, z", EXPORT_AGAIN) from error
    faces = found.get("face", {})
    polygons = next((faces[name] for name in ("vertex_indices", "vertex_index") if name in faces), None)
    if polygons is None:
        raise ArtifactError("the PLY has no faces, only points", "export a surface, not a point cloud")
    lengths, flat = polygons
    if np.asarray(flat).dtype.kind == "f" and not np.all((np.abs(flat) < 2**53) & (flat == np.rint(flat))):
        raise ArtifactError("face indices are not whole numbers", EXPORT_AGAIN)
    return vertices, triangulate(np.asarray(lengths, dtype=np.int64), np.asarray(flat).astype(np.int64))


def dump(vertices: Floats, faces: Ints) -> bytes:
    """Write binary little-endian PLY with float64 coordinates; the same mesh gives the same bytes.

    Examples
    --------
    >>> v, f = parse(dump(np.eye(3) / 3, np.array([[0, 1, 2]])))
    >>> bool((v == np.eye(3) / 3).all()), f.tolist()
    (True, [[0, 1, 2]])
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    rows["n"] = 3
    rows["i"] = faces
    return header.encode() + np.ascontiguousarray(vertices, dtype="<f8").tobytes() + rows.tobytes()
