"""Arrays that the processes of an engine share: files in a folder that all of them see."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmpipe.core.engine import Arrays, Content
from ssmpipe.runner.disk import replacing

_KEPT = 2


@dataclass(frozen=True)
class ArrayFile:
    """Arrays in a file; read wherever it is called."""

    path: Path

    def __call__(self) -> Arrays:
        """Return the arrays."""
        with self.path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


class SharedFolder:
    """Arrays as files named by their digest; the last few are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: list[Path] = []

    def share(self, arrays: Arrays) -> Content:
        """Write arrays, once."""
        digest = hashlib.sha256()
        for name in sorted(arrays):
            array = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
        key = digest.hexdigest()
        path = self.folder / f"{key}.npz"
        if not path.is_file():
            with replacing(path) as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
        self._files = [other for other in self._files if other != path] + [path]
        for old in self._files[:-_KEPT]:
            old.unlink(missing_ok=True)
        self._files = self._files[-_KEPT:]
        return Content(key, ArrayFile(path))

    def clear(self) -> None:
        """Remove the files."""
        for path in self._files:
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()
