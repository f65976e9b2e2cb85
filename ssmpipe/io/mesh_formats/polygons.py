"""What the mesh parsers share: triangulation of polygons, numbers from text, refusals."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError

MAX_TOKEN = 64
"""Longest number as text that is read."""

MAX_CORNERS = 255
"""Largest number of corners of one polygon; bone surfaces have three, hand-made files four."""

EXPORT_AGAIN = "export or copy the file again"


def byte_lines(data: bytes) -> Iterator[bytes]:
    """Return the lines of a file one after the other, whatever ends them; nothing is held but the file.

    Examples
    --------
    >>> list(byte_lines(b"a\\r\\nb\\nc"))
    [b'a\\r\\n', b'b\\n', b'c']
    >>> list(byte_lines(b"a\\rb"))
    [b'a\\n', b'b']
    """
    return iter(io.BytesIO(data if b"\n" in data else data.replace(b"\r", b"\n")))


def triangulate(corners: Ints, flat: Ints) -> Ints:
    """Split polygons into fans of triangles.

    Parameters
    ----------
    corners : (n_polygons,) int64
        Number of corners of each polygon.
    flat : (sum of corners,) int64
        Vertex indices, polygon after polygon.

    Returns
    -------
    (n_triangles, 3) int64
        In the order of the polygons; winding kept.

    Raises
    ------
    ArtifactError
        If a polygon has fewer than 3 or more than 255 corners.

    Examples
    --------
    >>> triangulate(np.array([3, 4]), np.array([0, 1, 2, 0, 2, 3, 4])).tolist()
    [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    """
    if len(corners) and (corners.min() < 3 or corners.max() > MAX_CORNERS):
        bad = int(corners.min() if corners.min() < 3 else corners.max())
        raise ArtifactError(f"a polygon has {bad} corners, 3 to {MAX_CORNERS} can be read", "export triangles")
    first = np.cumsum(corners) - corners
    n_triangles = corners - 2
    base = np.repeat(first, n_triangles)
    step = np.arange(len(base)) - np.repeat(np.cumsum(n_triangles) - n_triangles, n_triangles)
    return np.stack([flat[base], flat[base + step + 1], flat[base + step + 2]], axis=1).astype(np.int64).reshape(-1, 3)


def strips_to_triangles(lengths: Ints, flat: Ints) -> Ints:
    """Turn triangle strips into triangles; every second one is turned round, as the format says."""
    if len(lengths) and lengths.min() < 3:
        raise ArtifactError(f"a triangle strip has {int(lengths.min())} points, it needs 3", EXPORT_AGAIN)
    n = lengths - 2
    base = np.repeat(np.cumsum(lengths) - lengths, n)
    step = np.arange(len(base)) - np.repeat(np.cumsum(n) - n, n)
    i = base + step
    odd = step % 2
    return np.stack([flat[i], flat[i + 1 + odd], flat[i + 2 - odd]], axis=1).reshape(-1, 3)


def to_floats(tokens: Sequence[bytes], what: str) -> Floats:
    """Turn text tokens into numbers, or refuse with the first that is none.

    Examples
    --------
    >>> to_floats([b"1", b"2.5"], "x").tolist()
    [1.0, 2.5]
    """
    try:
        return _text_array(tokens, what).astype(np.float64)
    except ValueError as error:
        raise ArtifactError(f"{what}: not a number ({str(error)[:80]})", EXPORT_AGAIN) from error


def to_ints(tokens: Sequence[bytes], what: str) -> Ints:
    """Turn text tokens into whole numbers, or refuse.

    Examples
    --------
    >>> to_ints([b"1", b"-2"], "index").tolist()
    [1, -2]
    """
    try:
        return _text_array(tokens, what).astype(np.int64)
    except (ValueError, OverflowError) as error:
        raise ArtifactError(f"{what}: not a whole number ({str(error)[:80]})", EXPORT_AGAIN) from error


def _text_array(tokens: Sequence[bytes], what: str) -> np.ndarray:
    if not tokens:
        return np.zeros(0)
    if max(map(len, tokens)) > MAX_TOKEN:
        raise ArtifactError(f"{what}: a number has more than {MAX_TOKEN} characters", EXPORT_AGAIN)
    return np.array(tokens)
