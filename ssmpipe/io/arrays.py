"""Arrays in ``.npz`` files: no pickles, nothing allocated on the word of a header, same arrays same bytes."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ssmpipe.core.errors import ArtifactError

MAX_BYTES = 4 * 2**30
MAX_RATIO = 100
"""Largest ratio of unpacked to packed bytes of a member above 64 MiB; this package stores its arrays unpacked."""

_SMALL = 64 * 2**20
_REMEDY = "make it again, or copy it again from where it came"


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays without compression; numpy gives every member the same fixed date, so the bytes repeat.

    Raises
    ------
    ArtifactError
        If an array would need a pickle.
    """
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    for name, value in plain.items():
        if value.dtype.hasobject:
            raise ArtifactError(f"'{name}' holds Python objects, only numbers and text can be written")
    save: Any = np.savez  # its stubs take every keyword for an option
    with open(path, "wb") as file:
        save(file, **plain)


def read_npz(path: Path, names: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Read all arrays of an ``.npz`` file and check that those in ``names`` are there.

    Raises
    ------
    ArtifactError
        If it is no such file, an array is missing, is larger than 4 GiB or than its data, or holds Python objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            total = sum(info.file_size for info in archive.infolist())
            if total > MAX_BYTES:
                raise ArtifactError(f"{path.name} declares {total} bytes of arrays, at most {MAX_BYTES} are read")
            names_in = [info.filename for info in archive.infolist()]
            if len(set(names_in)) < len(names_in):
                raise ArtifactError(f"{path.name} holds an array twice", _REMEDY)
            for info in archive.infolist():
                if info.file_size > _SMALL and info.file_size > MAX_RATIO * max(info.compress_size, 1):
                    raise ArtifactError(
                        f"{path.name}: '{info.filename}' unpacks to {info.file_size} bytes from {info.compress_size}",
                        "store it without compression (numpy.savez)",
                    )
                _check_member(archive, info)
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except ArtifactError:
        raise
    except FileNotFoundError as error:
        raise ArtifactError(f"{path.name} does not exist", _REMEDY) from error
    except (Exception, SystemExit) as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise ArtifactError(f"{path.name} is not a readable .npz file ({text})", _REMEDY) from error
    missing = [name for name in names if name not in arrays]
    if missing:
        have = ", ".join(sorted(arrays)) or "none"
        raise ArtifactError(f"{path.name} has no array {', '.join(missing)}; it has: {have}", _REMEDY)
    return arrays


def _check_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    """Compare the shape that a member's header declares with the bytes that it has."""
    with archive.open(info) as member:
        version = npy.read_magic(member)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(member)
        if dtype.hasobject:
            raise ArtifactError(f"'{info.filename}' holds Python objects, which are never loaded", _REMEDY)
        declared = int(np.prod(np.array(shape, dtype=object))) * dtype.itemsize
        present = info.file_size - member.tell()
    if min(shape, default=0) < 0 or declared != present:
        raise ArtifactError(f"'{info.filename}' declares {declared} bytes, {present} are there", _REMEDY)
