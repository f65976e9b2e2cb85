"""Versions, machine, seed and the resolved config: enough to run it again."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from ruamel.yaml import YAML

from ssmpipe.report.page import fill
from ssmpipe.report.section import ReportData, Section


def render(data: ReportData) -> Section:
    """Return versions and config as they were used."""
    record = data.record
    versions = {str(key): str(value) for key, value in sorted((record.get("versions") or {}).items())}
    machine = {str(key): str(value) for key, value in sorted((record.get("machine") or {}).items())}
    config = as_yaml(record["config"]) if record.get("config") else ""
    html = fill(
        "provenance.html.j2",
        ssmpipe=record.get("ssmpipe_version", ""),
        versions=versions,
        machine=machine,
        seed=record.get("seed"),
        config=config,
    )
    return Section("provenance", "Software and settings", html)


def as_yaml(value: Any) -> str:
    """Return a config as YAML text, short lists on one line.

    Examples
    --------
    >>> print(as_yaml({"name": "a", "stages": [{"optimize": {"landmarks": (51, 51)}}]}), end="")
    name: a
    stages:
    - optimize:
        landmarks: [51, 51]
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False
    yaml.width = 100
    yaml.allow_unicode = True
    out = io.StringIO()
    yaml.dump(_plain(value), out)
    return out.getvalue()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)
