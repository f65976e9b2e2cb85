"""A private place for matplotlib's cache where the user's home cannot be written; otherwise matplotlib complains on every start."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "MPLCONFIGDIR"


def give_a_cache() -> None:
    """Set ``MPLCONFIGDIR`` to a private folder when it is not set and matplotlib's own folders cannot be written.

    Must be called before matplotlib is imported. The same user gets the same folder again, so that the fonts are listed once and
    child processes share them. Pictures do not depend on it: the report draws in its own style, whatever stands in a matplotlibrc.
    """
    if os.environ.get(VARIABLE) or all(map(_can_be_made, default_folders(os.environ))):
        return
    with contextlib.suppress(OSError):  # no place at all: matplotlib says so
        os.environ[VARIABLE] = str(_own_folder() or _new_folder())


def default_folders(environment: Mapping[str, str]) -> list[Path]:
    """Return where matplotlib would keep its settings and its cache; none where it finds a place that we need not know.

    Examples
    --------
    >>> [path.as_posix() for path in default_folders({"XDG_CONFIG_HOME": "/a", "XDG_CACHE_HOME": "/b"})] if sys.platform == "linux" else []
    ['/a/matplotlib', '/b/matplotlib']
    """
    if sys.platform == "win32":
        return []
    try:
        home = Path.home()
    except RuntimeError:
        home = Path(os.devnull)  # nothing can be made in it
    if sys.platform == "darwin":
        return [home / ".matplotlib"]
    given = ((environment.get(f"XDG_{name.upper()}_HOME"), home / f".{name}") for name in ("config", "cache"))
    return [Path(base or usual) / "matplotlib" for base, usual in given]


def _can_be_made(folder: Path) -> bool:
    try:
        there = next(path for path in (folder, *folder.parents) if path.exists())
    except (OSError, StopIteration):
        return False
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _own_folder() -> Path | None:
    """Return a folder of this user in the place for temporary files; None where another user might have a hand in it."""
    if not hasattr(os, "getuid"):
        return None
    folder = Path(tempfile.gettempdir()) / f"ssmpipe-matplotlib-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.lstat()
    ours = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077
    return folder if ours else None


def _new_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="ssmpipe-matplotlib-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
