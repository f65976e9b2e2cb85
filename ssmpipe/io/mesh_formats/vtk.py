"""Legacy VTK POLYDATA, ASCII and binary, file versions 1 to 5: points, polygons, triangle strips."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, strips_to_triangles, to_floats, to_ints, triangulate

_TYPES = {
    "float": "f4", "double": "f8", "int": "i4", "unsigned_int": "u4", "short": "i2", "unsigned_short": "u2",
    "char": "i1", "unsigned_char": "u1", "long": "i8", "unsigned_long": "u8", "vtktypeint64": "i8", "vtkidtype": "i8",
}  # fmt: skip
_MAX_SECTIONS = 1000
_EMPTY_LINE = re.compile(rb"\n[ \t\r]*\n")


@dataclass
class _Cursor:
    data: bytes
    binary: bool
    at: int = 0

    def line(self) -> list[str]:
        """Return the words of the next line that is not empty; [] at the end of the file."""
        while self.at < len(self.data):
            end = self.data.find(b"\n", self.at)
            end = len(self.data) if end < 0 else end
            words = self.data[self.at : end].decode("latin-1").split()
            self.at = end + 1
            if words:
                return words
        return []

    def array(self, kind: str, count: int, what: str) -> Floats | Ints:
        """Read ``count`` numbers, after checking that the file can hold them."""
        if kind.lower() not in _TYPES:
            raise ArtifactError(
                f"VTK: {what} has the unknown type '{kind[:20]}'", "save as legacy VTK with float or double"
            )
        dtype = np.dtype(">" + _TYPES[kind.lower()])
        size = dtype.itemsize if self.binary else 2
        if count < 0 or count * size > len(self.data) - self.at + 1:
            raise ArtifactError(
                f"truncated VTK: {what} needs {count} numbers, {max(len(self.data) - self.at, 0)} bytes are left",
                EXPORT_AGAIN,
            )
        if self.binary:
            values = np.frombuffer(self.data, dtype=dtype, count=count, offset=self.at)
            self.at += values.nbytes
            return values.astype(np.float64) if dtype.kind == "f" else values.astype(np.int64)
        tokens = self._tokens(count)
        if len(tokens) < count:
            raise ArtifactError(f"truncated VTK: {what} needs {count} numbers, {len(tokens)} are there", EXPORT_AGAIN)
        return to_floats(tokens, what) if dtype.kind == "f" else to_ints(tokens, what)

    def _tokens(self, count: int) -> list[bytes]:
        """Return the next ``count`` words, or as many as there are; looks no farther than it must."""
        if count == 0:
            return []
        width = 16 * count + 256
        while True:
            window = self.data[self.at : self.at + width]
            words = window.split(maxsplit=count)
            if len(words) > count or self.at + width >= len(self.data):
                rest = len(words[count]) if len(words) > count else 0
                self.at += len(window) - rest
                return words[:count]
            width *= 4


def _cells(cursor: _Cursor, words: list[str], version: float) -> tuple[Ints, Ints]:
    """Return the corners of each cell and their indices, from either layout of the format."""
    what = words[0].upper()
    n, size = int(words[1]), int(words[2])
    if version >= 5:
        header = cursor.line()
        if len(header) != 2 or header[0].upper() != "OFFSETS":
            raise ArtifactError(f"not a readable VTK: {what} has no OFFSETS", EXPORT_AGAIN)
        offsets = cursor.array(header[1], n, what).astype(np.int64)
        header = cursor.line()
        if len(header) != 2 or header[0].upper() != "CONNECTIVITY":
            raise ArtifactError(f"not a readable VTK: {what} has no CONNECTIVITY", EXPORT_AGAIN)
        flat = cursor.array(header[1], size, what).astype(np.int64)
        if n and (offsets[0] != 0 or offsets[-1] != size or np.any(np.diff(offsets) < 0)):
            raise ArtifactError(f"not a readable VTK: the offsets of {what} do not fit its indices", EXPORT_AGAIN)
        return np.diff(offsets), flat
    mixed = cursor.array("int", size, what).astype(np.int64)
    if what in ("VERTICES", "LINES"):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    if n and size == 4 * n and np.all(mixed[::4] == 3):
        return np.full(n, 3, dtype=np.int64), mixed.reshape(n, 4)[:, 1:].reshape(-1)
    starts: list[int] = []
    at, corners = 0, memoryview(mixed.tobytes()).cast("q")
    for i in range(n):
        if at >= size or not 0 <= corners[at] < size - at:
            raise ArtifactError(
                f"not a readable VTK: {what} number {i} runs over the {size} numbers stated", EXPORT_AGAIN
            )
        if corners[at] < 3:
            raise ArtifactError(f"a polygon has {corners[at]} corners, it needs 3", "export triangles")
        starts.append(at)
        at += 1 + corners[at]
    if at != size:
        raise ArtifactError(f"not a readable VTK: {what} says {size} numbers, {at} are used", EXPORT_AGAIN)
    keep = np.ones(size, dtype=bool)
    keep[starts] = False
    return mixed[~keep], mixed[keep]


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read a legacy VTK file that holds POLYDATA.

    Raises
    ------
    ArtifactError
        If it is another data set, truncated, or its counts do not fit.
    """
    cursor = _Cursor(data, binary=False)
    match = re.match(rb"#\s*vtk\s+datafile\s+version\s+(\d+\.\d+)", data[:80], re.IGNORECASE)
    if match is None:
        raise ArtifactError("not a readable VTK: the first line is not '# vtk DataFile Version'", EXPORT_AGAIN)
    version = float(match.group(1))
    cursor.at = data.find(b"\n", data.find(b"\n") + 1) + 1  # the title may be empty
    form = [w.upper() for w in cursor.line()]
    if data.count(b"\n", 0, 400) < 2 or form not in (["ASCII"], ["BINARY"]):
        raise ArtifactError("not a readable VTK: the third line is neither ASCII nor BINARY", EXPORT_AGAIN)
    cursor.binary = form == ["BINARY"]
    dataset = cursor.line()
    if [w.upper() for w in dataset] != ["DATASET", "POLYDATA"]:
        raise ArtifactError(
            f"VTK: '{' '.join(dataset)[:40]}' is not POLYDATA", "extract the surface and save it as PolyData"
        )
    vertices: Floats | None = None
    triangles: list[Ints] = []
    n_sections = 0
    while words := cursor.line():
        n_sections += 1
        if n_sections > _MAX_SECTIONS:
            raise ArtifactError(f"not a readable VTK: more than {_MAX_SECTIONS} sections", EXPORT_AGAIN)
        key = words[0].upper()
        if key in ("POINT_DATA", "CELL_DATA"):
            break
        try:
            if key == "POINTS":
                vertices = cursor.array(words[2], 3 * int(words[1]), key).astype(np.float64).reshape(-1, 3)
            elif key in ("POLYGONS", "TRIANGLE_STRIPS", "VERTICES", "LINES"):
                lengths, flat = _cells(cursor, words, version)
                if key == "POLYGONS":
                    triangles.append(triangulate(lengths, flat))
                elif key == "TRIANGLE_STRIPS":
                    triangles.append(strips_to_triangles(lengths, flat))
            elif key == "METADATA":
                end = _EMPTY_LINE.search(data, cursor.at - 1)
                cursor.at = end.end() if end else len(data)
            elif key == "FIELD":
                if int(words[2]) > _MAX_SECTIONS:
                    raise ArtifactError(f"not a readable VTK: a field of {words[2][:20]} arrays", EXPORT_AGAIN)
                for _ in range(int(words[2])):
                    name, n_components, n_tuples, kind = cursor.line()
                    cursor.array(kind, int(n_components) * int(n_tuples), f"field {name[:20]}")
            else:
                raise ArtifactError(f"not a readable VTK: unknown section '{words[0][:30]}'", EXPORT_AGAIN)
        except (IndexError, ValueError) as error:
            raise ArtifactError(f"not a readable VTK: line '{' '.join(words)[:60]}'", EXPORT_AGAIN) from error
    if vertices is None:
        raise ArtifactError("not a readable VTK: it has no POINTS", EXPORT_AGAIN)
    if not triangles:
        raise ArtifactError("the VTK file has no polygons", "export a surface, not a point cloud")
    return vertices, np.concatenate(triangles)
