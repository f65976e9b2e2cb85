"""STL, binary and ASCII: unconnected triangles, whose equal corners are merged."""

from __future__ import annotations

import re

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.mesh_formats.polygons import EXPORT_AGAIN, to_floats

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(
    rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.IGNORECASE | re.MULTILINE
)  # blanks, not \s: over many empty lines that would take quadratic time


def parse(data: bytes) -> tuple[Floats, Ints]:
    """Read an STL file.

    A file is binary when its size is 84 + 50 n with the n of its header, whatever its first word says; trailing
    bytes are refused, since nothing tells them from a file that was cut or joined.

    Raises
    ------
    ArtifactError
        If the size does not fit the header, or an ASCII file is incomplete.
    """
    if len(data) >= 84:
        n_faces = int.from_bytes(data[80:84], "little")
        if len(data) == 84 + 50 * n_faces:
            corners = np.frombuffer(data, dtype=_RECORD, offset=84, count=n_faces)["corners"]
            return merge_corners(corners.astype(np.float64))
    head = data[:2000].lstrip().lower()
    if head.startswith(b"solid") and (b"facet" in head or b"endsolid" in head):
        return merge_corners(_parse_ascii(data))
    if len(data) < 84:
        raise ArtifactError(f"not a readable STL: {len(data)} bytes, the shortest header has 84", EXPORT_AGAIN)
    raise ArtifactError(
        f"not a readable STL: the header says {n_faces} triangles = {84 + 50 * n_faces} bytes, it has {len(data)}",
        EXPORT_AGAIN,
    )


def _parse_ascii(data: bytes) -> Floats:
    n_facets = len(re.findall(rb"\bfacet\s+normal\b", data, re.IGNORECASE))
    n_ends = len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE))
    n_vertices = len(re.findall(rb"\bvertex\b", data, re.IGNORECASE))
    corners = _VERTEX.findall(data) if n_ends == n_facets and n_vertices == 3 * n_facets else []
    if n_ends != n_facets or len(corners) != 3 * n_facets:
        raise ArtifactError(
            f"incomplete ASCII STL: {n_facets} facets begin, {n_ends} end, {len(corners) or n_vertices} vertices",
            EXPORT_AGAIN,
        )
    if b"endsolid" not in data[-400:].lower():
        raise ArtifactError(f"incomplete ASCII STL: no 'endsolid' after {n_facets} facets", EXPORT_AGAIN)
    return to_floats([number for corner in corners for number in corner], "vertex").reshape(-1, 3, 3)


def merge_corners(corners: Floats) -> tuple[Floats, Ints]:
    """Merge equal corners of (n, 3, 3) triangles; vertices keep the order of their first appearance.

    Examples
    --------
    >>> square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0.0]]])
    >>> merge_corners(square)[1].tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    points = corners.reshape(-1, 3)
    if not len(points):
        return points, np.zeros((0, 3), dtype=np.int64)
    order = np.lexsort(points.T)
    differs = np.r_[True, np.any(points[order][1:] != points[order][:-1], axis=1)]
    group = np.empty(len(points), dtype=np.int64)
    group[order] = np.cumsum(differs) - 1
    first = order[differs]  # lexsort is stable: the first of each group appeared first
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return points[np.sort(first)], rank[group].reshape(-1, 3)
