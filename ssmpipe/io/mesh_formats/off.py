"""OFF in ASCII: vertices and faces; colours are skipped."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, MAX_CORNERS, to_floats, to_ints, triangulate


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read an ASCII OFF file.

    Raises
    ------
    ArtifactError
        If the header is not one, or there are fewer lines than it says.
    """
    lines = [words for line in data.splitlines() if (words := line.split(b"#", 1)[0].split())]
    if not lines or lines[0][0] not in (b"OFF", b"COFF", b"NOFF"):
        raise ArtifactError("not a readable OFF: it does not begin with 'OFF'", EXPORT_AGAIN)
    if lines[0][0] != b"OFF":
        raise ArtifactError(f"OFF with extra columns per vertex ({lines[0][0].decode()})", "export plain OFF or PLY")
    counts, first = (lines[0][1:], 1) if len(lines[0]) > 1 else (lines[1] if len(lines) > 1 else [], 2)
    try:
        n_vertices, n_faces = int(counts[0]), int(counts[1])
    except (ValueError, IndexError) as error:
        raise ArtifactError("not a readable OFF: the line of counts is missing", EXPORT_AGAIN) from error
    rows = lines[first:]
    if n_vertices < 0 or n_faces < 0 or len(rows) < n_vertices + n_faces:
        raise ArtifactError(
            f"truncated OFF: the header says {n_vertices} vertices and {n_faces} faces, {len(rows)} lines follow",
            EXPORT_AGAIN,
        )
    if any(len(row) != 3 for row in rows[:n_vertices]):
        raise ArtifactError("not a readable OFF: a vertex line does not hold 3 numbers", EXPORT_AGAIN)
    for row in rows[n_vertices : n_vertices + n_faces]:
        if not row[0].isdigit() or not 3 <= int(row[0]) <= min(MAX_CORNERS, len(row) - 1):
            raise ArtifactError(
                f"not a readable OFF: face line '{b' '.join(row)[:40].decode('latin-1')}'", EXPORT_AGAIN
            )

    vertices = to_floats([number for row in rows[:n_vertices] for number in row], "vertex").reshape(-1, 3)
    polygons = rows[n_vertices : n_vertices + n_faces]
    corners = np.array([int(row[0]) for row in polygons], dtype=np.int64)
    flat = to_ints([index for row in polygons for index in row[1 : int(row[0]) + 1]], "face")
    return vertices, triangulate(corners, flat)
