"""Planar outlines in and out: CSV with a header ``x,y``, and ``.pts``."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np

from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.tables import read_rows, read_text

OUTLINE_SUFFIXES = (".csv", ".pts")
"""Suffixes that :func:`read_outline` accepts, in lower case."""

_ENDS_MEET = "# open: the ends meet"


def read_outline(path: Path) -> Outline:
    """Read ordered points; the outline is closed when the last point repeats the first.

    Parameters
    ----------
    path : Path
        ``.csv`` with columns ``x`` and ``y`` (others are ignored), or ``.pts`` (``version``, ``n_points``, pairs in braces).
        Coordinates are taken as they stand: y may point down.

    Raises
    ------
    ArtifactError
        Naming file and line.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in OUTLINE_SUFFIXES:
        raise ArtifactError(
            f"'{path.suffix}' is not a format of outlines that can be read ({' '.join(OUTLINE_SUFFIXES)})",
            "save the points as CSV with a header x,y",
        )
    points = _read_csv(path) if suffix == ".csv" else _read_pts(path)
    if len(points) < 3:
        raise ArtifactError(f"{path.name} has {len(points)} points, an outline needs at least 3", "check the file")
    closed = bool(np.array_equal(points[0], points[-1])) and not read_text(path).startswith(_ENDS_MEET)
    try:
        return Outline(points[:-1] if closed else points, closed)
    except GeometryError as error:
        raise ArtifactError(f"{path.name}: {error.fact}", error.remedy) from error


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise ArtifactError(f"{where}: '{cell[:40]}' is not a number", "write one point per line") from error
    if not math.isfinite(value):
        raise ArtifactError(f"{where}: the coordinate is not finite", "remove the point")
    return value


def _read_csv(path: Path) -> np.ndarray:
    header, rows = read_rows(path, "x")
    names = [name.lower() for name in header]
    if "y" not in names:
        raise ArtifactError(f"{path.name}: no column 'y'", "the header is x,y")
    if "landmark" in names:
        raise ArtifactError(f"{path.name} is a table of landmarks, not an outline", "give it as input.landmarks")
    at = names.index("x"), names.index("y")
    return np.array([[_number(cells[k], f"{path.name}, line {line}") for k in at] for line, cells in rows])


def _read_pts(path: Path) -> np.ndarray:
    text = read_text(path)
    inside = text.partition("{")[2].partition("}")[0] if "{" in text else text
    rows = [(number, line.split()) for number, line in enumerate(inside.splitlines(), start=1) if line.strip()]
    for number, cells in rows:
        if len(cells) != 2:
            raise ArtifactError(f"{path.name}, point line {number}: {len(cells)} numbers, need 2", "write x y")
    return np.array([[_number(cell, f"{path.name}, point line {number}") for cell in cells] for number, cells in rows])


def write_outline(path: Path, outline: Outline) -> None:
    """Write ``x,y`` with all digits; a closed outline repeats its first point at the end.

    Raises
    ------
    ArtifactError
        If the suffix is not ``.csv``.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise ArtifactError(f"'{path.suffix}' is not a format of outlines that can be written", "use .csv")
    out = io.StringIO()
    if not outline.closed and np.array_equal(outline.points[0], outline.points[-1]):
        out.write(f"{_ENDS_MEET}\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["x", "y"])
    writer.writerows([repr(x), repr(y)] for x, y in outline.ring.tolist())
    path.write_bytes(out.getvalue().encode())
