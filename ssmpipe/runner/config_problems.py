"""What is wrong with a config, one line for each problem: its place, what it is, what was probably meant."""

from __future__ import annotations

import json
import types
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.document import Document, Loc
from ssmpipe.runner.suggest import did_you_mean


class ConfigErrors(ConfigError):
    """All problems of a config file, one line each."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return (ConfigErrors, (self.problems,))


def validated(model: type[BaseModel], data: Any, at: Loc, document: Document, problems: list[str]) -> Any:
    """Return ``data`` as an instance of ``model``; None, and a line in ``problems`` for each, where it is not valid.

    Parameters
    ----------
    model : pydantic model
    data : any
        As read from YAML.
    at : tuple
        Its place in the document.
    document : Document
        Knows the lines.
    problems : list of str
        Gets what is wrong.
    """
    try:
        return model.model_validate_json(json.dumps(data))
    except ValidationError as error:
        for loc, text in explain(error, model, data):
            full = (*at, *loc)
            shown = ".".join(str(part) for part in full)
            problems.append(f"{document.where(full)}: {shown}: {text}" if shown else f"{document.where(full)}: {text}")
        return None


def explain(error: ValidationError, model: type[BaseModel], data: Any) -> list[tuple[Loc, str]]:
    """Turn pydantic's errors into (path, one line) pairs, those of a union's branches joined."""
    grouped: dict[Loc, list[str]] = {}
    tails: dict[Loc, str] = {}
    for item in error.errors(include_url=False):
        loc, value = _existing(item["loc"], data)
        kind = item["type"]
        if kind == "extra_forbidden":
            texts, tail = ["unknown key"], did_you_mean(str(item["loc"][-1]), _known_keys(model, item["loc"][:-1]))
        elif kind == "missing":
            loc, texts, tail = tuple(item["loc"]), ["is missing"], ""
        else:
            message = item["msg"].removeprefix("Value error, ").removeprefix("Input ").strip()
            shown = json.dumps(value, ensure_ascii=False)
            texts, tail = [message], f" (got {shown if len(shown) <= 80 else shown[:77] + '...'})"
        for text in texts:
            if text not in grouped.setdefault(loc, []):
                grouped[loc].append(text)
        tails[loc] = tail
    return [(loc, " or ".join(texts) + tails[loc]) for loc, texts in grouped.items()]


def _existing(loc: Iterable[Any], data: Any) -> tuple[Loc, Any]:
    """Cut the tags of union branches off a pydantic location: keep the part that exists in the data."""
    kept: list[Any] = []
    for part in loc:
        if (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
            kept.append(part)
        elif not isinstance(data, dict | list):
            break
    return tuple(kept), data


def _known_keys(model: Any, loc: Sequence[Any]) -> list[str]:
    for part in loc:
        fields = getattr(model, "model_fields", None)
        if fields is None or part not in fields:
            return []
        model = _model_of(fields[part].annotation)
    return list(getattr(model, "model_fields", {}))


def _model_of(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((a for a in get_args(annotation) if hasattr(a, "model_fields")), None)
    return annotation
