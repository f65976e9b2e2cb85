"""Planar outlines in and out: CSV with a header ``x,y``; ``.pts`` and ``.asf``, which name points as well, are read."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.point_lists import MAX_POINTS, number_in, read_asf, read_pts
from ssmpipe.io.tables import read_rows, read_text

OUTLINE_SUFFIXES = (".csv", ".pts", ".asf")
"""Suffixes that :func:`read_outline` accepts, in lower case."""

_ENDS_MEET = "# open: the ends meet"


def read_outline(path: Path, remarks: list[str] | None = None) -> Outline:
    """Read ordered points; the outline is closed when the last point repeats the first, or an ``.asf`` file says so.

    Parameters
    ----------
    path : Path
        ``.csv`` with columns ``x`` and ``y`` (others are ignored), ``.pts`` or ``.asf`` (see :mod:`ssmpipe.io.point_lists`).
        Coordinates are taken as they stand: y may point down.
    remarks : list of str, optional
        Gets what the user should know of a file that can be read all the same.

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
    if suffix == ".asf":
        annotation = read_asf(path, remarks)
        return _outline(path, annotation.points, annotation.closed)
    points = _read_csv(path) if suffix == ".csv" else read_pts(path)
    closed = len(points) > 1 and bool(np.array_equal(points[0], points[-1]))
    closed = closed and not read_text(path).startswith(_ENDS_MEET)
    return _outline(path, points[:-1] if closed else points, closed)


def _outline(path: Path, points: np.ndarray, closed: bool) -> Outline:
    n_points = len(points) + closed
    if n_points < 3:
        raise ArtifactError(f"{path.name} has {n_points} points, an outline needs at least 3", "check the file")
    try:
        return Outline(points, closed)
    except GeometryError as error:
        raise ArtifactError(f"{path.name}: {error.fact}", error.remedy) from error


def _read_csv(path: Path) -> np.ndarray:
    header, rows = read_rows(path, "x")
    names = [name.lower() for name in header]
    if "y" not in names:
        raise ArtifactError(f"{path.name}: no column 'y'", "the header is x,y")
    if "landmark" in names:
        raise ArtifactError(f"{path.name} is a table of landmarks, not an outline", "give it as input.landmarks")
    at = names.index("x"), names.index("y")
    points: list[list[float]] = []
    for line, cells in rows:
        if len(points) >= MAX_POINTS:
            raise ArtifactError(f"{path.name} has more than {MAX_POINTS} points", "take every tenth point")
        points.append([number_in(cells[k], f"{path.name}, line {line}") for k in at])
    return np.array(points)


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
