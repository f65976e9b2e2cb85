"""Cohort tables of spreadsheets, and tables of our own."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ssmpipe.contract import Table
from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.tables import read_cohort, read_table, write_table

GOOD = {
    "commas": b"id,side,group\nfemur_01,L,a\nfemur_02,R,b\n",
    "semicolons": b"id;side;group\nfemur_01;L;a\nfemur_02;R;b\n",
    "tabs": b"id\tside\tgroup\nfemur_01\tL\ta\nfemur_02\tR\tb\n",
    "byte order mark, crlf": b"\xef\xbb\xbfID,side,group\r\nfemur_01,L,a\r\nfemur_02,R,b\r\n",
    "excel": b"sep=;\nid;side;group\nfemur_01;L;a\n;;\nfemur_02;R;b",
    "capitals": b"ID,Side,GROUP\nfemur_01,L,a\nfemur_02,R,b\n",
    "comment, blanks, quotes": b'# our cohort\n\n side , id,group\n"L", femur_01 ,a\n\nR,femur_02,b\n',
}


@pytest.mark.parametrize("name", GOOD)
def test_cohort_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "cohort.csv").write_bytes(GOOD[name])
    cohort = read_cohort(tmp_path / "cohort.csv")
    assert cohort == {"femur_01": {"side": "L", "group": "a"}, "femur_02": {"side": "R", "group": "b"}}


BAD = {
    b"": "is empty",
    b"name,side\na,L\n": "line 1: no column 'id'",
    b"id,side\na,L\nb,R\na,R\n": "line 4: id 'a' occurs already in line 2",
    b"id,side\na,L\n,R\n": "line 3: the id is empty",
    b"id,side\na,L,3\n": "line 2: 3 cells, the header has 2",
    b"id,side,side\na,L,R\n": "column 'side' occurs twice",
    b"id,name\na,M\xfcller\n": "not UTF-8",
    b'id,name\na,"b\n': "line 2: .*end of data",
}


@pytest.mark.parametrize("data", BAD)
def test_bad_cohort_is_refused_with_its_line(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "cohort.csv").write_bytes(data)
    with pytest.raises(ArtifactError, match=BAD[data]) as caught:
        read_cohort(tmp_path / "cohort.csv")
    assert "cohort.csv" in str(caught.value)


def test_missing_cohort_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"cohort\.csv cannot be read"):
        read_cohort(tmp_path / "cohort.csv")


def test_table_keeps_numbers_and_text(tmp_path: Path) -> None:
    table = Table(
        {
            "id": ["1", "2"], "x": [1 / 3, -1e-300], "n": [3, -4], "code": ["007", "08"], "text": ["a,b", 'q"'],
            "gap": [None, 2.5], "sign": [math.inf, 1.0],
        },
        "mm, two\nlines",
    )  # fmt: skip
    write_table(tmp_path / "t.csv", table)
    again = read_table(tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().splitlines()[0] == "# mm, two lines"
    assert again.comment == "mm, two lines"
    assert math.isnan(again.columns["gap"][0])
    for name in ("id", "x", "n", "code", "text", "sign"):
        assert again.columns[name] == table.columns[name], name


def test_table_without_rows_keeps_its_columns(tmp_path: Path) -> None:
    write_table(tmp_path / "t.csv", Table({"a": [], "b": []}))
    assert read_table(tmp_path / "t.csv").columns == {"a": [], "b": []}


def test_ragged_tables_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="unequal length"):
        write_table(tmp_path / "t.csv", Table({"a": [1], "b": []}))
    (tmp_path / "t.csv").write_text("a,b\n1\n")
    with pytest.raises(ArtifactError, match="not a readable table"):
        read_table(tmp_path / "t.csv")
