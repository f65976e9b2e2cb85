"""Content digests: of files, of artifacts, and of all that determines a task's output."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEMA = 1
VOLATILE = "volatile"  # stands for the digest of a file that holds timings


def canonical(data: Any) -> str:
    """Return JSON with sorted keys and no spaces: equal data, equal text.

    Examples
    --------
    >>> canonical({"b": 1, "a": [1.5, None]})
    '{"a":[1.5,null],"b":1}'
    """
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def digest(data: Any) -> str:
    """Return the sha256 of the canonical JSON of ``data``."""
    return hashlib.sha256(canonical(data).encode("utf-8", "surrogatepass")).hexdigest()


def file_digest(path: Path) -> str:
    """Return the sha256 of a file's content."""
    with path.open("rb") as file:
        sha = hashlib.sha256()
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()


def slot_digest(files: Mapping[str, str]) -> str:
    """Return the digest of an artifact from the digests of its files."""
    return digest(sorted(files.items()))


def fingerprint(
    *,
    stage: str,
    version: int,
    config: Mapping[str, Any],
    inputs: Mapping[str, str | None],
    seed: int,
    shape: str | None,
) -> str:
    """Return the digest of all that determines a task's output, and of nothing else.

    Folders, machine, number of jobs and library versions stay out.
    """
    return digest(
        {
            "schema": SCHEMA,
            "stage": stage,
            "version": version,
            "config": dict(config),
            "inputs": dict(inputs),
            "seed": seed,
            "shape": shape,
        }
    )
