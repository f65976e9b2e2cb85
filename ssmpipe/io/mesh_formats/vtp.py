"""VTK XML PolyData (.vtp): inline or appended, text, base64 or raw, plain or compressed; points, polygons, triangle strips.

Nothing is allocated by what the file says of itself before that was held against the bytes that are there.
"""

from __future__ import annotations

import binascii
import lzma
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.etree.ElementTree import ParseError, XMLParser
from xml.sax.saxutils import quoteattr

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, strips_to_triangles, to_floats, to_ints, triangulate

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4", "Int64": "i8",
    "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
_COMPRESSORS = ("", "vtkZLibDataCompressor", "vtkLZMADataCompressor")
_APPENDED = re.compile(rb"<AppendedData\b[^>]*>\s*_")
_MAX_ELEMENTS = 100_000
_MAX_DEPTH = 20
_MAX_RATIO = 200
"""Largest ratio of unpacked to packed bytes; surfaces reach about ten."""


@dataclass
class _Array:
    section: str
    attributes: dict[str, str]
    text: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.section} {self.attributes.get('Name', '')[:30]}".strip()


@dataclass
class _Document:
    """Target of the XML parser: keeps the attributes of the file and the arrays of each piece, nothing else."""

    root: dict[str, str] = field(default_factory=dict)
    pieces: list[tuple[dict[str, str], list[_Array]]] = field(default_factory=list)
    path: list[str] = field(default_factory=list)
    n_elements: int = 0
    open_array: _Array | None = None

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.n_elements += 1
        if self.n_elements > _MAX_ELEMENTS or len(self.path) > _MAX_DEPTH:
            raise ArtifactError("not a readable VTP: too many or too deeply nested elements", EXPORT_AGAIN)
        if not self.path:
            self.root = dict(attributes, tag=tag)
        elif tag == "Piece":
            self.pieces.append((dict(attributes), []))
        elif tag == "DataArray" and self.pieces and self.path[-1] in ("Points", "Polys", "Strips"):
            self.open_array = _Array(self.path[-1], dict(attributes))
            self.pieces[-1][1].append(self.open_array)
        self.path.append(tag)

    def end(self, tag: str) -> None:
        self.path.pop()
        if tag == "DataArray":
            self.open_array = None

    def data(self, text: str) -> None:
        if self.open_array is not None:
            self.open_array.text.append(text)

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise ArtifactError("not a readable VTP: it declares a document type", EXPORT_AGAIN)

    def close(self) -> None:
        """End of the file."""


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read a VTK XML file that holds PolyData; several pieces are put together.

    Raises
    ------
    ArtifactError
        If it is another data set, truncated, its counts do not fit, or it is packed in a way that cannot be read.
    """
    appended = _APPENDED.search(data)
    text, tail = (data[: appended.start()], memoryview(data)[appended.end() :]) if appended else (data, memoryview(b""))
    document = _Document()
    parser = XMLParser(target=document)
    try:
        parser.feed(text)
        if appended is None:
            parser.close()
    except (ParseError, ValueError, LookupError) as error:
        raise ArtifactError(f"not a readable VTP ({str(error)[:80]})", EXPORT_AGAIN) from error
    root = document.root
    if root.get("tag") != "VTKFile":
        raise ArtifactError("not a readable VTP: its first element is not VTKFile", EXPORT_AGAIN)
    if root.get("type") != "PolyData":
        raise ArtifactError(
            f"VTP: '{root.get('type', '')[:40]}' is not PolyData", "extract the surface and save it as PolyData"
        )
    if not document.pieces:
        raise ArtifactError("the VTP file has no pieces", EXPORT_AGAIN)
    reader = _Reader(root, tail, appended is not None and b'"base64"' in appended.group())
    parts = [_piece(reader, attributes, arrays) for attributes, arrays in document.pieces]
    offsets = np.cumsum([0, *(len(points) for points, _ in parts[:-1])])
    triangles = np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)])
    if len(triangles) == 0:
        raise ArtifactError("the VTP file has no polygons", "export a surface, not a point cloud")
    return np.concatenate([points for points, _ in parts]), triangles


def _piece(reader: _Reader, attributes: dict[str, str], arrays: list[_Array]) -> tuple[Floats, Ints]:
    def find(section: str, name: str | None = None) -> _Array:
        for array in arrays:
            if array.section == section and name in (None, array.attributes.get("Name")):
                return array
        raise ArtifactError(f"not a readable VTP: {section} has no {name or 'coordinates'}", EXPORT_AGAIN)

    n_points = _count(attributes, "NumberOfPoints")
    if n_points == 0:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    points = reader.array(find("Points"), 3 * n_points).astype(np.float64).reshape(-1, 3)
    faces = [np.empty((0, 3), dtype=np.int64)]
    for section, key, split in (
        ("Polys", "NumberOfPolys", triangulate),
        ("Strips", "NumberOfStrips", strips_to_triangles),
    ):
        n_cells = _count(attributes, key)
        if n_cells == 0:
            continue
        ends = reader.array(find(section, "offsets"), n_cells).astype(np.int64)
        corners = np.diff(ends, prepend=0)
        if corners.min() < 0:
            raise ArtifactError(f"not a readable VTP: the offsets of {section} do not increase", EXPORT_AGAIN)
        flat = reader.array(find(section, "connectivity"), int(ends[-1])).astype(np.int64)
        if len(flat) and (flat.min() < 0 or flat.max() >= n_points):
            bad = flat.min() if flat.min() < 0 else flat.max()
            raise ArtifactError(f"face index {bad} is out of range, there are {n_points} vertices", EXPORT_AGAIN)
        faces.append(split(corners, flat))
    return points, np.concatenate(faces)


def _count(attributes: dict[str, str], key: str) -> int:
    value = attributes.get(key, "0").strip()
    if not value.isascii() or not value.isdigit() or len(value) > 18:
        raise ArtifactError(f"not a readable VTP: {key} is '{value[:30]}'", EXPORT_AGAIN)
    return int(value)


class _Reader:
    """Decodes the arrays of one file."""

    def __init__(self, root: dict[str, str], tail: memoryview, tail_is_base64: bool) -> None:
        order = {"LittleEndian": "<", "BigEndian": ">"}.get(root.get("byte_order", "LittleEndian"))
        header = {"UInt32": "u4", "UInt64": "u8"}.get(root.get("header_type", "UInt32"))
        self.compressor = root.get("compressor", "")
        if order is None or header is None:
            raise ArtifactError("not a readable VTP: unknown byte_order or header_type", EXPORT_AGAIN)
        self.order, self.header = order, np.dtype(order + header)
        self.tail, self.tail_is_base64 = tail, tail_is_base64

    def array(self, array: _Array, count: int) -> Floats | Ints:
        """Return exactly ``count`` numbers of an array."""
        kind = _TYPES.get(array.attributes.get("type", ""))
        if kind is None:
            raise ArtifactError(
                f"VTP: {array.name} has the unknown type '{array.attributes.get('type', '')[:20]}'", EXPORT_AGAIN
            )
        form = array.attributes.get("format", "")
        dtype = np.dtype(self.order + kind)
        if form == "ascii":
            text = "".join(array.text)
            if 2 * count > len(text) + 1:
                raise self._truncated(array, count)
            tokens = text.encode().split(maxsplit=count)[:count]
            if len(tokens) < count:
                raise self._truncated(array, count)
            return to_floats(tokens, array.name) if dtype.kind == "f" else to_ints(tokens, array.name)
        packed: _Raw | _Base64
        if form == "binary":
            raw = memoryview("".join("".join(array.text).split()).encode())
            packed = _Base64(raw)
        elif form == "appended":
            offset = _count(array.attributes, "offset")
            if offset >= len(self.tail):
                raise self._truncated(array, count)
            raw = self.tail[offset:]
            packed = _Base64(raw) if self.tail_is_base64 else _Raw(raw)
        else:
            raise ArtifactError(f"VTP: {array.name} has the unknown format '{form[:20]}'", EXPORT_AGAIN)
        try:
            content = self._unpack(packed, count * dtype.itemsize)
        except (binascii.Error, zlib.error, lzma.LZMAError, EOFError, ValueError, OverflowError) as error:
            raise ArtifactError(
                f"truncated or damaged VTP: {array.name} needs {count} numbers ({str(error)[:60]})", EXPORT_AGAIN
            ) from error
        return np.frombuffer(content, dtype=dtype)

    def _unpack(self, packed: _Raw | _Base64, n_bytes: int) -> bytes:
        size = self.header.itemsize
        if self.compressor not in _COMPRESSORS:
            raise ArtifactError(
                f"VTP: packed with {self.compressor[:40]}, which cannot be read",
                "save it without compression, or as .ply",
            )
        if not self.compressor:
            stated = int(packed.take(size, self.header)[0])
            if stated != n_bytes:
                raise ValueError(f"its header says {stated} bytes, {n_bytes} are needed")
            return packed.rest(n_bytes)
        n_blocks = int(packed.peek(size, self.header)[0])
        if n_blocks * size > packed.size:
            raise ValueError(f"its header says {n_blocks} blocks")
        head = packed.take((3 + n_blocks) * size, self.header).astype(np.uint64)
        block, last, sizes = int(head[1]), int(head[2]), [int(x) for x in head[3:]]
        unpacked = [block] * (n_blocks - bool(last)) + [last] * bool(last and n_blocks)
        if sum(unpacked) != n_bytes:
            raise ValueError(f"its blocks hold {sum(unpacked)} bytes, {n_bytes} are needed")
        if sum(sizes) > packed.size or any(u > _MAX_RATIO * s + 10_000 for u, s in zip(unpacked, sizes, strict=True)):
            raise ValueError("its blocks do not fit the file")
        content = packed.rest(sum(sizes))
        out, at = [], 0
        for wanted, stored in zip(unpacked, sizes, strict=True):
            out.append(_expand(self.compressor, content[at : at + stored], wanted))
            at += stored
        return b"".join(out)

    def _truncated(self, array: _Array, count: int) -> ArtifactError:
        return ArtifactError(f"truncated VTP: {array.name} needs {count} numbers", EXPORT_AGAIN)


def _expand(compressor: str, block: bytes, n_bytes: int) -> bytes:
    """Unpack one block, never more than ``n_bytes``."""
    if compressor == "vtkZLibDataCompressor":
        content = zlib.decompressobj().decompress(block, n_bytes)
    else:
        content = lzma.LZMADecompressor(memlimit=2**27).decompress(block, n_bytes)
    if len(content) != n_bytes:
        raise ValueError(f"a block holds {len(content)} bytes, {n_bytes} are needed")
    return content


class _Raw:
    """Bytes as they are."""

    def __init__(self, data: memoryview) -> None:
        self.data, self.at = data, 0

    @property
    def size(self) -> int:
        """Upper bound of the bytes that are there."""
        return len(self.data)

    def peek(self, n_bytes: int, dtype: np.dtype) -> np.ndarray:
        if n_bytes > len(self.data):
            raise ValueError(f"{len(self.data)} bytes are left")
        return np.frombuffer(self.data[:n_bytes], dtype=dtype)

    def take(self, n_bytes: int, dtype: np.dtype) -> np.ndarray:
        values = self.peek(n_bytes, dtype)
        self.at = n_bytes
        return values

    def rest(self, n_bytes: int) -> bytes:
        content = bytes(self.data[self.at : self.at + n_bytes])
        if len(content) != n_bytes:
            raise ValueError(f"{len(content)} bytes are left")
        return content


class _Base64:
    """Bytes in base64; the header is encoded by itself (then it ends in '=') or together with what follows."""

    def __init__(self, text: memoryview) -> None:
        self.text, self.at, self.skip = text, 0, 0

    @property
    def size(self) -> int:
        """Upper bound of the bytes that are there."""
        return 3 * len(self.text) // 4

    def peek(self, n_bytes: int, dtype: np.dtype) -> np.ndarray:
        n_characters = 4 * -(-n_bytes // 3)
        if n_characters > len(self.text):
            raise ValueError(f"{self.size} bytes are left")
        decoded = binascii.a2b_base64(self.text[:n_characters])
        return np.frombuffer(decoded[:n_bytes], dtype=dtype)

    def take(self, n_bytes: int, dtype: np.dtype) -> np.ndarray:
        values = self.peek(n_bytes, dtype)
        n_characters = 4 * -(-n_bytes // 3)
        apart = n_bytes % 3 == 0 or self.text[n_characters - 1 : n_characters] == b"="
        self.at, self.skip = (n_characters, 0) if apart else (4 * (n_bytes // 3), n_bytes % 3)
        return values

    def rest(self, n_bytes: int) -> bytes:
        n_characters = 4 * -(-(n_bytes + self.skip) // 3)
        content = binascii.a2b_base64(self.text[self.at : self.at + n_characters])[self.skip : self.skip + n_bytes]
        if len(content) != n_bytes:
            raise ValueError(f"{len(content)} bytes are left")
        return content


def dump(
    vertices: Floats,
    cells: Ints,
    point_data: Mapping[str, Floats] | None = None,
    field_data: Mapping[str, Floats] | None = None,
) -> bytes:
    """Write polygons of equal size and values per vertex; the same surface gives the same bytes.

    Parameters
    ----------
    vertices : (n, 3) float64
    cells : (n_cells, k) int64
        Triangles or quadrilaterals.
    point_data : mapping of str to (n,) or (n, k) float64, optional
    field_data : mapping of str to (m,) or (m, k) float64, optional
        Of the whole surface.
    """

    def array(name: str, values: Floats | Ints, extra: str = "") -> str:
        little = values.astype("<f8" if values.dtype.kind == "f" else "<i8")
        content = little.tobytes()
        packed = binascii.b2a_base64(len(content).to_bytes(8, "little") + content, newline=False).decode()
        kind = "Float64" if values.dtype.kind == "f" else "Int64"
        width = values.shape[1] if values.ndim == 2 else 1
        head = f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{width}"{extra} format="binary">'
        return f"{head}{packed}</DataArray>\n"

    data = "".join(array(name, values) for name, values in (point_data or {}).items())
    whole = "".join(array(k, v, extra=f' NumberOfTuples="{len(v)}"') for k, v in (field_data or {}).items())
    whole = f"<FieldData>\n{whole}</FieldData>\n" if whole else ""
    ends = cells.shape[1] * np.arange(1, len(cells) + 1)
    text = (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<PolyData>\n{whole}<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(cells)}">\n<PointData>\n{data}</PointData>\n<Points>\n{array("Points", vertices)}</Points>\n'
        f"<Polys>\n{array('connectivity', cells.ravel())}{array('offsets', ends)}</Polys>\n</Piece>\n</PolyData>\n</VTKFile>\n"
    )
    return text.encode()
