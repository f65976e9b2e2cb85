"""Templates: everything that comes from outside is escaped."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from ssmpipe.report.wording import count, label, number, percent


def resource(*path: str) -> str:
    """Return the text of a file that belongs to this package, with Unix line ends."""
    return files("ssmpipe.report").joinpath(*path).read_text(encoding="utf-8").replace("\r\n", "\n")


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: resource("templates", name)),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "separators": (",", ":"), "allow_nan": False}
    environment.filters.update(number=number, percent=percent, label=label)
    environment.globals["count"] = count
    return environment


def fill(template: str, **values: Any) -> Markup:
    """Fill a template of ``templates/`` and return escaped HTML."""
    return Markup(_environment().get_template(template).render(**values))
