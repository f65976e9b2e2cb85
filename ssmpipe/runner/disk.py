"""Writing so that a reader never sees a part, and a full disk is told from a bad patient."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

_WINDOWS = os.name == "nt"


class DiskError(OSError):
    """The output folder cannot be written: nothing a stage or a patient is to blame for."""


@contextmanager
def disk_errors() -> Iterator[None]:
    """Turn the failure to write into DiskError, so that no shape is blamed for a full disk."""
    try:
        yield
    except OSError as error:
        if isinstance(error, DiskError):
            raise
        raise DiskError(error.errno or errno.EIO, error.strerror or str(error), error.filename) from error


def write_atomically(path: Path, text: str, mode: int | None = None) -> None:
    """Write a text file so that a reader sees the old content or the new one, never a part; ``mode`` limits who may read it."""
    with replacing(path, mode) as file:
        file.write(text.encode("utf-8"))


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part."""
    with replacing(path) as file:
        file.write(content)


@contextmanager
def replacing(path: Path, mode: int | None = None) -> Iterator[IO[bytes]]:
    """Open a file that takes the place of ``path`` at the end, whole and on the disk; it is forgotten when that fails.

    With ``mode`` it has these permissions from its first byte on, where the system knows them (not on Windows).

    Raises
    ------
    DiskError
        If it cannot be written.
    """
    with disk_errors():
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            aside.unlink(missing_ok=True)  # of a killed process with this number; its permissions would stay
            with open(
                aside, "wb", opener=lambda name, flags: os.open(name, flags, 0o666 if mode is None else mode)
            ) as file:
                yield file
            flush(aside)
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)


def unwritable(folder: Path) -> str:
    """Return why nothing can be written into a folder, or an empty text; nothing is left behind.

    A folder that does not exist is looked for upwards: it would be made in the first that does.
    """
    place = folder
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    try:
        with tempfile.TemporaryFile(dir=place) as file:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return f"{place}: {error.strerror or error}"
    return ""


def flush(path: Path) -> None:
    """Make sure that a file, or the entries of a folder, are on the disk."""
    if _WINDOWS and path.is_dir():
        return
    handle = os.open(path, os.O_RDWR if _WINDOWS else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
