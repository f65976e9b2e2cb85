"""Wavefront OBJ: vertices and faces; texture, normals, groups and materials are skipped, no other file is opened."""

from __future__ import annotations

import re

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, MAX_CORNERS, byte_lines, to_floats, to_ints, triangulate

_SKIPPED = {
    b"vt", b"vn", b"vp", b"g", b"o", b"s", b"usemtl", b"mtllib", b"l", b"p", b"#", b"usemap", b"maplib", b"lod"
}  # fmt: skip


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read an OBJ file; negative indices count from the last vertex, as the format says.

    Raises
    ------
    ArtifactError
        If a line is not OBJ, an index is 0 or beyond the vertices, or no vertex is there.
    """
    for kind, word in (("vertices", rb"v"), ("faces", rb"f")):  # before a large file is walked line by line
        if not re.search(rb"^[ \t]*" + word + rb"[ \t]", data, re.MULTILINE):
            raise ArtifactError(f"not a readable OBJ: it has no {kind}", EXPORT_AGAIN)
    points: list[bytes] = []
    corners: list[int] = []
    indices: list[bytes] = []
    seen: list[int] = []  # number of vertices before each face: negative indices count from there
    for number, line in enumerate(byte_lines(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")), start=1):
        words = line.split(maxsplit=4 * MAX_CORNERS)
        if not words:
            continue
        if words[0] == b"v" and len(words) >= 4:
            points.extend(words[1:4])
        elif words[0] == b"f" and 4 <= len(words) <= MAX_CORNERS + 1:
            corners.append(len(words) - 1)
            indices.extend(word.split(b"/", 1)[0] for word in words[1:])
            seen.append(len(points) // 3)
        elif words[0] not in _SKIPPED and not words[0].startswith(b"#"):
            text = line[:40].strip().decode("latin-1")
            raise ArtifactError(f"not a readable OBJ: line {number} is '{text}'", EXPORT_AGAIN)
    if not points:
        raise ArtifactError("not a readable OBJ: it has no vertices", EXPORT_AGAIN)
    vertices = to_floats(points, "vertex").reshape(-1, 3)
    flat = to_ints(indices, "face")
    lengths = np.array(corners, dtype=np.int64)
    if len(flat) and (np.any(flat == 0) or np.abs(flat).max() > len(vertices)):
        bad = 0 if np.any(flat == 0) else int(flat[np.argmax(np.abs(flat))])
        raise ArtifactError(f"face index {bad} is out of range: the mesh has {len(vertices)} vertices", EXPORT_AGAIN)
    flat = np.where(flat < 0, flat + np.repeat(np.array(seen, dtype=np.int64), lengths), flat - 1)
    return vertices, triangulate(lengths, flat)
