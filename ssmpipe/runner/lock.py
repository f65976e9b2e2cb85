"""One run per output folder. The kernel frees the lock when its holder dies, so nothing is ever to be unlocked by hand."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.disk import disk_errors

LOCK = ".lock"


class LockHeldError(SsmpipeError):
    """Another run works on this output folder."""


@contextmanager
def locked(out: Path, part: str | None = None) -> Iterator[None]:
    """Hold the output folder, or one part of it (``--part``): parts exclude whole runs, not each other.

    Raises
    ------
    LockHeldError
        If another run holds it; says host, process and since when.
    """
    with disk_errors():
        out.mkdir(parents=True, exist_ok=True)
    mine = out / (LOCK if part is None else f"{LOCK}.part-{part}")
    with ExitStack() as stack:
        stack.enter_context(_held(mine, 0.0))
        _sign(mine)
        if part is None:
            for other in sorted(out.glob(f"{LOCK}.part-*")):
                if other.suffix != ".json":
                    with _held(other, 0.0):
                        pass
        else:
            with _held(out / LOCK, 2.0):
                pass
        yield


@contextmanager
def _held(path: Path, wait_s: float) -> Iterator[None]:
    lock = FileLock(path, timeout=wait_s)
    with disk_errors():
        try:
            lock.acquire()
        except Timeout:  # an OSError, but not one of the disk
            fact = f"another run holds {path.parent}{_holder(path)}"
            raise LockHeldError(fact, "wait for it, or choose another output folder") from None
    try:
        yield
    finally:
        lock.release()


def _sign(path: Path) -> None:
    holder = {
        "host": platform.node(),
        "pid": os.getpid(),
        "start": time.strftime("%Y-%m-%d %H:%M:%S"),
        "command": " ".join(sys.argv)[:300],
    }
    with disk_errors():
        path.with_name(path.name + ".json").write_text(json.dumps(holder) + "\n", encoding="utf-8")


def _holder(path: Path) -> str:
    try:
        holder = json.loads(path.with_name(path.name + ".json").read_text(encoding="utf-8"))
        return f" (host {holder['host']}, process {holder['pid']}, since {holder['start']})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
