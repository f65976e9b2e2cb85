"""``--set key.path=value``: keys of a config that the command line overrides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.document import Document, Loc, parse_value

_PATHS = (("input", "scans"), ("input", "cohort"), ("input", "landmarks"), ("output",))


def override(document: Document, text: str) -> None:
    """Set one key of a document to what ``key.path=value`` says, and note that in ``document.overrides``.

    A stage is addressed by its name or id, and added where it is not listed; paths become absolute, from the working folder.

    Raises
    ------
    ConfigError
        If it is not of that form, or leads to something without keys.
    """
    key, sep, raw = text.partition("=")
    parts = key.strip().split(".")
    if not sep or not all(parts):
        raise ConfigError(f"--set {text}: write it as key.path=value, for example --set seed=1")
    value = parse_value(raw)
    if tuple(parts) in _PATHS:
        value = [_absolute(v) for v in value] if isinstance(value, list) else _absolute(value)
    loc: Loc
    if parts[0] == "stages":
        loc = _override_stage(document, parts[1:], value, text)
    else:
        node = document.data
        for part in parts[:-1]:
            child = node.setdefault(part, {})
            if not isinstance(child, dict):
                raise ConfigError(f"--set {text}: '{part}' is not a section")
            node = child
        node[parts[-1]] = value
        loc = tuple(parts)
    document.overrides[loc] = text


def _override_stage(document: Document, parts: list[str], value: Any, text: str) -> Loc:
    if len(parts) < 2:
        raise ConfigError(f"--set {text}: name a stage and an option: stages.<stage>.<option>=value")
    stages = document.data.setdefault("stages", [])
    if not isinstance(stages, list):
        raise ConfigError(f"{document.where(('stages',))}: stages: must be a list")
    for i, entry in enumerate(stages):
        if entry == parts[0]:
            stages[i] = entry = {parts[0]: {}}
        if isinstance(entry, dict) and len(entry) == 1:
            name, options = next(iter(entry.items()))
            given = options.get("id", name) if isinstance(options, dict) else name
            if parts[0] == given:
                place, at = entry, (("stages", i, name))
                break
    else:
        place, at, name = {parts[0]: {}}, ("stages", len(stages), parts[0]), parts[0]
        stages.append(place)
        document.overrides[at[:2]] = text
    node = place
    for part in [name, *parts[1:-1]]:
        if node.get(part) is None:
            node[part] = {}
        node = node[part]
        if not isinstance(node, dict):
            raise ConfigError(f"--set {text}: '{part}' has no options")
    if isinstance(value, str) and value.count(".") and Path(value).is_file():
        value = _absolute(value)
    node[parts[-1]] = value
    return (*at, *parts[1:])


def _absolute(value: Any) -> Any:
    return str(Path.cwd() / value) if isinstance(value, str) else value
