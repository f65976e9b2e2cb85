"""Whatever is done to a file of any kind: it loads or is refused by an error for the user. A fixed number of examples."""

from __future__ import annotations

import functools

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssmpipe.core.errors import SsmpipeError

pytest.importorskip("resource", reason="the table of files needs a POSIX system")

from tests.support.hostile import _readers as readers
from tests.support.hostile import cases

SMALL = [case for case in cases() if not case.file.endswith((".yaml",)) or case.words == ""]
READERS = readers()


@functools.cache
def seeds() -> list[tuple[str, str, bytes]]:
    """Files of at most 4 kB, valid or not, as starting points."""
    found = []
    for case in SMALL:
        if "10 MB" not in case.name and "MB" not in case.name and "million" not in case.name:
            data = case.data()
            if len(data) <= 4096:
                found.append((case.reader, case.file, data))
    return found


WORDS = [
    b"nan",
    b"-1",
    b"1e999",
    b"4294967295",
    b"\xff",
    b"\x00",
    b'"',
    b",",
    b"\n",
    b"[",
    b"<",
    b"{",
    b"99999999999999999999",
]


@settings(max_examples=400, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(
    which=st.integers(0, 10**6),
    edits=st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 12), st.one_of(st.sampled_from(WORDS), st.binary(max_size=6))),
        max_size=4,
    ),
    keep=st.one_of(st.just(1.0), st.floats(0, 1)),
)
def test_any_damaged_file_loads_or_is_refused(
    which: int, edits: list, keep: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    reader, file, data = seeds()[which % len(seeds())]
    for place, removed, inserted in edits:
        at = int(place * len(data))
        data = data[:at] + inserted + data[at + removed :]
    path = tmp_path_factory.getbasetemp() / file
    path.write_bytes(data[: int(keep * len(data))])
    try:
        READERS[reader](path)
        text = "loaded"
    except SsmpipeError as error:
        text = str(error)
    finally:
        path.unlink()
    assert text.strip().encode("utf-8"), "a message that can be printed"


def test_the_seeds_cover_every_reader() -> None:
    assert {reader for reader, _, _ in seeds()} == set(READERS) - {"arrays"}  # which "spline" reads through
