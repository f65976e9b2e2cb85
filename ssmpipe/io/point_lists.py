"""Numbered points of one picture: ``.pts`` files, and ``.asf`` files of active appearance models.

``.pts`` holds one ``x y`` per line, in pixels or any other unit: bare, or between braces after ``version`` and ``n_points``.
``.asf`` (Stegmann, AAM-API, 2000) holds the number of points, one line ``path type x y number from to`` for each, x and y as shares of
the picture's width and height, and the name of the picture. The picture is looked up beside the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.images import IMAGE_SUFFIXES, image_size
from ssmpipe.io.tables import read_text, text_lines

_OPEN_PATH = 4  # bit of the type
MAX_POINTS = 300_000
"""Largest number of points of one outline."""

_MAX_DIGITS = 12


@dataclass(frozen=True, eq=False)
class Annotation:
    """What an ``.asf`` file says.

    Parameters
    ----------
    points : (n, 2) float64
        In pixels of the picture, y down; shares of its width and height where ``scaled`` is False.
    closed : bool
    scaled : bool
        Whether the picture was found.
    """

    points: Floats
    closed: bool
    scaled: bool


def point_names(n: int) -> list[str]:
    """Return the names that numbered points get as landmarks: ``point_01 ...``.

    Examples
    --------
    >>> point_names(2)
    ['point_01', 'point_02']
    """
    digits = max(2, len(str(n)))
    return [f"point_{k + 1:0{digits}d}" for k in range(n)]


def read_pts(path: Path) -> Floats:
    """Return the points of a ``.pts`` file, (n, 2).

    Raises
    ------
    ArtifactError
        Naming file and line.
    """
    text = read_text(path)
    inside, promised = text, None
    if "{" in text:
        head, _, rest = text.partition("{")
        inside, brace, _ = rest.partition("}")
        if not brace:
            raise ArtifactError(f"{path.name}: the closing brace is missing", "the file is cut off, copy it again")
        for line in head.lower().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "n_points":
                promised = _count(value)
    points: list[list[float]] = []
    for number, line in enumerate(text_lines(inside), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path.name}, point line {number}"
        if len(points) >= MAX_POINTS:
            raise ArtifactError(f"{path.name} has more than {MAX_POINTS} points", "take every tenth point")
        cells = line.split(maxsplit=2)
        if len(cells) != 2:
            raise ArtifactError(f"{where}: {len(line.split(maxsplit=100))} numbers, need 2", "write x y")
        points.append([number_in(cell, where) for cell in cells])
    if promised is not None and promised != len(points):
        raise ArtifactError(
            f"{path.name} promises {promised} points and has {len(points)}", "the file is cut off, copy it again"
        )
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def read_asf(path: Path, remarks: list[str] | None = None) -> Annotation:
    """Read the points of an ``.asf`` file.

    Parameters
    ----------
    path : Path
    remarks : list of str, optional
        Gets a line when the picture is not found, so that the points stay shares of its width and height.

    Raises
    ------
    ArtifactError
        Naming file and line; also when the points form several paths.
    """
    lines = (
        (k, line.strip())
        for k, line in enumerate(text_lines(read_text(path)), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    )
    n = _count(next(lines, (0, ""))[1])
    if n is None:
        raise ArtifactError(
            f"{path.name} does not begin with a number of points", "check that it is an .asf file of the AAM-API"
        )
    rows: list[list[float]] = []
    for k, line in islice(lines, n):
        cells = line.split(maxsplit=7)[:7]
        if len(rows) >= MAX_POINTS:
            raise ArtifactError(f"{path.name} has more than {MAX_POINTS} points", "take every tenth point")
        if len(cells) < 7:
            raise _fewer(f"{path.name}, line {k}", n)
        rows.append([number_in(cell, f"{path.name}, line {k}") for cell in cells])
    if len(rows) < n:
        raise _fewer(path.name, n)
    table = np.array(rows).reshape(-1, 7)
    paths = np.unique(table[:, 0])
    if len(paths) > 1:
        counts = ", ".join(str(int((table[:, 0] == p).sum())) for p in paths)
        raise ArtifactError(
            f"{path.name} has {len(paths)} paths ({counts} points), an outline is one",
            "keep the points of one path, and their number in the first line",
        )
    closed = bool(n) and not np.any(table[:, 1].astype(int) & _OPEN_PATH)
    points = table[:, 2:4]
    name = next(lines, (0, ""))[1]
    picture = _picture_beside(path, name)
    if picture is None:
        if remarks is not None:
            remarks.append(
                f"the picture '{name}' is not beside {path.name}: points stay shares of its width and height, so shapes are "
                "stretched; put the pictures there"
            )
        return Annotation(points, closed, False)
    return Annotation(points * np.array(image_size(picture), dtype=np.float64), closed, True)


def _count(text: str) -> int | None:
    text = text.strip()
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS else None


def _fewer(where: str, n: int) -> ArtifactError:
    return ArtifactError(
        f"{where}: {n} points of 7 numbers each are promised, not all are there", "the file is cut off, copy it again"
    )


def _picture_beside(path: Path, name: str) -> Path | None:
    """Return the picture that the file names, or one of the file's own name; folders in the name are left out."""
    names = [name.replace("\\", "/").rpartition("/")[2]] if name else []
    names += [path.stem + suffix for suffix in IMAGE_SUFFIXES]
    wanted = {n.lower(): k for k, n in reversed(list(enumerate(names)))}
    found = sorted(
        (wanted[p.name.lower()], p.name, p)
        for p in path.resolve().parent.iterdir()
        if p.name.lower() in wanted and p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()
    )
    return found[0][2] if found else None


def number_in(cell: str, where: str) -> float:
    """Return the finite number in a cell; refuse anything else by its place.

    Raises
    ------
    ArtifactError
    """
    try:
        value = float(cell)
    except ValueError as error:
        raise ArtifactError(f"{where}: '{cell[:40]}' is not a number", "write one point per line") from error
    if not math.isfinite(value):
        raise ArtifactError(f"{where}: the coordinate is not finite", "remove the point")
    return value
