"""A YAML file with the line of every key, or an override from the command line; nothing is interpreted here.

YAML 1.2 (``no`` is a word, ``1e-6`` a number). Duplicate keys, anchors, aliases, tags and very deep nesting are refused:
each of them can make a file mean something else than what a reader sees, or blow up when it is walked.
"""

from __future__ import annotations

import datetime
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from ssmpipe.core.errors import ConfigError

MAX_DEPTH = 20
MAX_BYTES = 2_000_000
Loc = tuple[Any, ...]


@dataclass
class Document:
    """Plain data (dict, list, str, int, float, bool, None) and where each part of it came from.

    Parameters
    ----------
    data : dict
    name : str
        File name for messages.
    lines : dict of tuple to int
        Path of keys and indices to line number (from 1).
    overrides : dict of tuple to str
        Path of an overridden key to the text of the ``--set`` option.
    """

    data: dict[str, Any]
    name: str
    lines: dict[Loc, int] = field(default_factory=dict)
    overrides: dict[Loc, str] = field(default_factory=dict)

    def where(self, loc: Loc) -> str:
        """Return ``file:line`` of the nearest known part of ``loc``, or the ``--set`` option that set it."""
        for length in range(len(loc), -1, -1):
            part = tuple(loc[:length])
            if part in self.overrides:
                return f"--set {self.overrides[part]}"
            if part in self.lines:
                return f"{self.name}:{self.lines[part]}"
        return self.name


def read_document(path: Path) -> Document:
    """Read a YAML file whose top level is a mapping.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not such a file; the message starts with ``file:line``.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(f"{path}: larger than {MAX_BYTES} bytes, this is no config file")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: cannot read the config file: {why}", "ssmpipe init writes one") from error
    root = _load(text, str(path))
    if root is None:
        raise ConfigError(f"{path}: the config file is empty", "ssmpipe init writes a commented one")
    if not isinstance(root, dict):
        raise ConfigError(f"{path}:1: the config must be a mapping of keys (name, input, output, ...)")
    lines: dict[Loc, int] = {(): 1}
    return Document(_plain(root, (), lines), str(path), lines)


def parse_value(text: str) -> Any:
    """Return the plain data of a YAML value given on the command line.

    Examples
    --------
    >>> parse_value("[8, 8]"), parse_value("1e-6"), parse_value("no")
    ([8, 8], 1e-06, 'no')
    """
    return _plain(_load(text, "value"), (), {})


def _load(text: str, name: str) -> Any:
    try:
        depth = 0
        for event in YAML(typ="rt").parse(io.StringIO(text)):
            kind = type(event).__name__
            line = event.start_mark.line + 1
            if kind == "AliasEvent" or getattr(event, "anchor", None):
                raise ConfigError(f"{name}:{line}: anchors and aliases (& and *) are not allowed; write the value out")
            if getattr(event, "tag", None):
                raise ConfigError(f"{name}:{line}: tags (!) are not allowed; write the plain value")
            depth += kind.endswith("StartEvent") - kind.endswith("EndEvent")
            if depth > MAX_DEPTH:
                raise ConfigError(f"{name}:{line}: nested deeper than {MAX_DEPTH} levels")
        return YAML(typ="rt").load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        problem = (error.problem or error.context or "not valid YAML").strip().splitlines()[0]
        raise ConfigError(f"{name}:{line}: {problem}") from None
    except (YAMLError, RecursionError, ValueError, TypeError, LookupError, AttributeError, AssertionError) as error:
        raise ConfigError(
            f"{name}: not valid YAML: {str(error).splitlines()[0] if str(error) else 'unreadable'}"
        ) from None


def _plain(node: Any, loc: Loc, lines: dict[Loc, int]) -> Any:
    if isinstance(node, dict):
        for key in node:
            if hasattr(node, "lc"):
                lines[(*loc, str(key))] = node.lc.key(key)[0] + 1
        return {str(key): _plain(value, (*loc, str(key)), lines) for key, value in node.items()}
    if isinstance(node, list):
        for i in range(len(node)):
            if hasattr(node, "lc"):
                lines[(*loc, i)] = node.lc.item(i)[0] + 1
        return [_plain(value, (*loc, i), lines) for i, value in enumerate(node)]
    if node is None or isinstance(node, bool):
        return node
    if isinstance(node, int):
        return bool(node) if type(node).__name__ == "ScalarBoolean" else int(node)
    if isinstance(node, float):
        return float(node)
    if isinstance(node, datetime.date):
        return node.isoformat()
    return str(node)
