"""Hooks of mkdocs: leave pages that do not exist out of the navigation, name files outside the site instead of linking them."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Drop navigation entries without a page."""
    config["nav"] = _existing(config["nav"], Path(config["docs_dir"]))
    return config


def _existing(nav: list[Any], folder: Path) -> list[Any]:
    kept: list[Any] = []
    for entry in nav:
        if isinstance(entry, str):
            kept += [entry] if (folder / entry).is_file() else []
        else:
            ((title, value),) = entry.items()
            if isinstance(value, list):
                inner = _existing(value, folder)
                kept += [{title: inner}] if inner else []
            elif (folder / value).is_file():
                kept.append(entry)
    return kept


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links to files of the repository that the site does not hold into their names."""
    base = posixpath.dirname(page.file.src_uri)

    def replaced(match: re.Match[str]) -> str:
        text, target = match.group(1), match.group(2)
        place = posixpath.normpath(posixpath.join(base, target))
        if not place.startswith("..") and not place.endswith(".py"):
            return match.group(0)
        name = posixpath.normpath(posixpath.join("docs", place))
        return f"{text} (`{name}`)" if text.strip("`") != name else f"`{name}`"

    return _LINK.sub(replaced, markdown)
