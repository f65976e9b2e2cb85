"""CSV tables: the cohort table, and the tables that stages write."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.errors import ArtifactError

MAX_BYTES = 256 * 2**20
# columns of the cohort table that mean something to the software, in whatever case they are written
COHORT_COLUMNS = ("id", "path", "side", "group", "subject")
MAX_COLUMNS = 10_000


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file, with or without byte order mark.

    Raises
    ------
    ArtifactError
        If it is missing, larger than 256 MiB, or not UTF-8.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ArtifactError(f"{path.name} has {path.stat().st_size} bytes, at most {MAX_BYTES} are read")
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ArtifactError(
            f"{path.name} is not UTF-8 text (byte {error.start})", "save it as 'CSV UTF-8' or plain UTF-8 text"
        ) from error
    except OSError as error:
        raise ArtifactError(f"{path.name} cannot be read ({error.strerror or error})", "check the path") from error


def text_lines(text: str) -> Iterator[str]:
    """Return the lines of a text one after the other, each with its end; nothing is held but the text.

    Examples
    --------
    >>> list(text_lines("a\\r\\nb"))
    ['a\\r\\n', 'b']
    """
    return iter(io.StringIO(text, newline=""))


def read_rows(path: Path, key: str, known: Sequence[str] = ()) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Return the header and, one by one, the (line number, cells) of a CSV file whose header has the column ``key``.

    The delimiter is the one of ``, ; tab`` that makes ``key`` a column. ``key`` and the ``known`` columns are returned in lower case,
    others as they are written. Lines that are empty or start with ``#``
    before the header, and empty lines after it, are skipped; cells are stripped.

    Raises
    ------
    ArtifactError
        If no header has the column, a column is named twice, or a row has another number of cells; names the line.
    """
    lines = text_lines(read_text(path))
    numbered = ((k, line) for k, line in enumerate(lines, start=1) if line.strip())
    start, first = next(((k, line) for k, line in numbered if not line.startswith(("#", "sep="))), (0, ""))
    if not first:
        raise ArtifactError(f"{path.name} is empty", f"give it a header line with the column '{key}'")
    if max(first.count(delimiter) for delimiter in ",;\t") >= MAX_COLUMNS:
        raise ArtifactError(f"{path.name}, line {start}: more than {MAX_COLUMNS} columns", "save it as CSV again")
    header: list[str] = []
    for delimiter in ",;\t":
        try:
            header = [cell.strip() for cell in next(csv.reader([first], delimiter=delimiter))]
        except csv.Error as error:
            raise ArtifactError(f"{path.name}, line {start}: {error}", "save it as CSV again") from error
        if key in [cell.lower() for cell in header]:
            break
    else:
        raise ArtifactError(
            f"{path.name}, line {start}: no column '{key}' in '{first.strip()[:80]}'",
            f"name the columns in the first line, separated by , or ; and call one of them '{key}'",
        )
    header = [cell.lower() if cell.lower() in (key, *known) else cell for cell in header]
    twice = sorted(cell for cell, n in Counter(header).items() if n > 1)
    if twice:
        raise ArtifactError(f"{path.name}, line {start}: column '{twice[0]}' occurs twice", "rename one of them")
    return header, _rows(path.name, lines, start, delimiter, len(header))


def _rows(name: str, lines: Iterator[str], start: int, delimiter: str, width: int) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            line = start + reader.line_num
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != width:
                raise ArtifactError(
                    f"{name}, line {line}: {len(cells)} cells, the header has {width}",
                    "quote cells that contain the delimiter",
                )
            yield line, [cell.strip() for cell in cells]
    except csv.Error as error:
        raise ArtifactError(f"{name}, line {start + reader.line_num}: {error}", "save it as CSV again") from error


def read_cohort(path: Path) -> dict[str, dict[str, str]]:
    """Read the cohort table: one row per shape, text by column name, the ``id`` itself left out.

    Parameters
    ----------
    path : Path
        CSV in UTF-8 with a column ``id``, delimited by ``,`` ``;`` or tab. Names of columns that have a meaning (``id path side
        group subject``) may be written in any case.

    Raises
    ------
    ArtifactError
        If there is no ``id`` column, an id is empty or occurs twice, or a row is ragged; names the line.
    """
    header, rows = read_rows(path, "id", COHORT_COLUMNS)
    at = header.index("id")
    cohort: dict[str, dict[str, str]] = {}
    line_of: dict[str, int] = {}
    for line, cells in rows:
        shape_id = cells[at]
        if not shape_id:
            raise ArtifactError(f"{path.name}, line {line}: the id is empty", "give every shape an id")
        if shape_id in cohort:
            raise ArtifactError(
                f"{path.name}, line {line}: id '{shape_id}' occurs already in line {line_of[shape_id]}",
                "remove one of them",
            )
        line_of[shape_id] = line
        cohort[shape_id] = {name: cell for i, (name, cell) in enumerate(zip(header, cells, strict=True)) if i != at}
    return cohort


def write_table(path: Path, table: Table) -> None:
    """Write a table as CSV: ``# comment`` first when there is one; floats with all their digits, missing ones empty.

    Raises
    ------
    ArtifactError
        If the columns differ in length.
    """
    lengths = {name: len(column) for name, column in table.columns.items()}
    if len(set(lengths.values())) > 1:
        raise ArtifactError(f"{path.name}: columns of unequal length {lengths}")
    out = io.StringIO()
    if table.comment:
        out.write("# " + " ".join(table.comment.split()) + "\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(zip(*([_cell(value) for value in column] for column in table.columns.values()), strict=True))
    path.write_bytes(out.getvalue().encode())


def _cell(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def read_table(path: Path) -> Table:
    """Read what :func:`write_table` wrote.

    A column comes back as int or float when every cell is written exactly as Python writes that number (so that "007"
    stays text), with NaN for empty cells; the columns ``id``, ``subject`` and ``group`` are always text.

    Raises
    ------
    ArtifactError
        If it is not a table.
    """
    text = read_text(path)
    comment = ""
    if text.startswith("# "):
        first, _, text = text.partition("\n")
        comment = first[2:].rstrip("\r")
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise ArtifactError(f"{path.name} is not a readable table ({error})", "run the stage again") from error
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise ArtifactError(f"{path.name} is not a readable table", "run the stage again")
    names, cells = rows[0], rows[1:]
    columns = {
        name: list(column) if name in ("id", "subject", "group") else _numbers(list(column))
        for name, column in zip(names, zip(*cells, strict=True) if cells else [()] * len(names), strict=True)
    }
    return Table(columns, comment)


def _numbers(cells: list[str]) -> list[Any]:
    for kind in (int, float):
        try:
            if cells and all(str(kind(cell)) == cell for cell in cells if cell or kind is int) and any(cells):
                return [kind(cell) if cell else math.nan for cell in cells]
        except ValueError:
            continue
    return cells
