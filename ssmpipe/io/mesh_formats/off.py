"""OFF in ASCII: vertices and faces; colours are skipped."""

from __future__ import annotations

from itertools import islice

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, MAX_CORNERS, byte_lines, to_floats, to_ints, triangulate


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read an ASCII OFF file.

    Raises
    ------
    ArtifactError
        If the header is not one, or there are fewer lines than it says.
    """
    limit = MAX_CORNERS + 8  # a face, its number of corners, a colour
    lines = (words for line in byte_lines(data) if (words := line.split(b"#", 1)[0].split(maxsplit=limit)))
    head = next(lines, [b""])
    if head[0] not in (b"OFF", b"COFF", b"NOFF"):
        raise ArtifactError("not a readable OFF: it does not begin with 'OFF'", EXPORT_AGAIN)
    if head[0] != b"OFF":
        raise ArtifactError(f"OFF with extra columns per vertex ({head[0].decode()})", "export plain OFF or PLY")
    counts = head[1:] or next(lines, [])
    try:
        n_vertices, n_faces = int(counts[0]), int(counts[1])
    except (ValueError, IndexError) as error:
        raise ArtifactError("not a readable OFF: the line of counts is missing", EXPORT_AGAIN) from error
    says = f"truncated OFF: the header says {n_vertices} vertices and {n_faces} faces"
    if n_vertices < 0 or n_faces < 0 or 6 * n_vertices + 8 * n_faces > len(data) + 8:
        raise ArtifactError(f"{says}, the file has {len(data)} bytes", EXPORT_AGAIN)
    points: list[bytes] = []
    for row in islice(lines, n_vertices):
        if len(row) != 3:
            raise ArtifactError("not a readable OFF: a vertex line does not hold 3 numbers", EXPORT_AGAIN)
        points.extend(row)
    corners: list[int] = []
    indices: list[bytes] = []
    for row in islice(lines, n_faces):
        n = int(row[0]) if row[0].isdigit() and len(row[0]) < 4 else 0
        if not 3 <= n <= min(MAX_CORNERS, len(row) - 1) or len(row) > limit:
            raise ArtifactError(
                f"not a readable OFF: face line '{b' '.join(row)[:40].decode('latin-1')}'", EXPORT_AGAIN
            )
        corners.append(n)
        indices.extend(row[1 : n + 1])
    if len(points) < 3 * n_vertices or len(corners) < n_faces:
        n_lines = len(points) // 3 + len(corners)
        raise ArtifactError(f"{says}, {n_lines} lines follow", EXPORT_AGAIN)
    vertices = to_floats(points, "vertex").reshape(-1, 3)
    return vertices, triangulate(np.array(corners, dtype=np.int64), to_ints(indices, "face"))
