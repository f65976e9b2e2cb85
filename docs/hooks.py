"""Hooks of mkdocs: a navigation of the pages that are there, and the names of files outside the site instead of links to them."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Drop navigation entries without a page, and list pages without an entry under "More"."""
    config["nav"] = complete(config["nav"], Path(config["docs_dir"]))
    return config


def complete(nav: list[Any], folder: Path) -> list[Any]:
    """Return a navigation that holds every page of the folder once."""
    kept = _existing(nav, folder)
    pages = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.md"))
    more = [page for page in pages if page not in listed(kept)]
    return [*kept, {"More": more}] if more else kept


def listed(nav: Any) -> list[str]:
    """Return the pages of a navigation in their order."""
    if isinstance(nav, str):
        return [nav]
    return [page for entry in (nav.values() if isinstance(nav, dict) else nav) for page in listed(entry)]


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
