"""Millimetres in the words of the stages, where the config says that lengths have no unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

FILE_UNITS = "file units"
_MM = re.compile(r"\bmm\b")
_KEY = re.compile(r"_mm([23]?)$")


def without_mm(text: str) -> str:
    """Replace the unit in a sentence.

    Examples
    --------
    >>> without_mm("the hole of 3.5 mm is 2 mm wide (mmm)")
    'the hole of 3.5 file units is 2 file units wide (mmm)'
    """
    return _MM.sub(FILE_UNITS, text)


def unit_key(name: str) -> str:
    """Return the name of a metric whose lengths have no unit.

    Examples
    --------
    >>> [unit_key(name) for name in ("rms_mm", "area_mm2", "n_faces", "mm_total")]
    ['rms_unit', 'area_unit2', 'n_faces', 'mm_total']
    """
    return _KEY.sub(r"_unit\1", name)


def record_without_mm(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a run with "mm" replaced in metrics, warnings, failures and methods; the config stays as it is.

    Examples
    --------
    >>> record_without_mm({"cohort_stages": [{"metrics": {"rms_mm": 1}, "warnings": ["1 mm off"]}]})["cohort_stages"]
    [{'metrics': {'rms_unit': 1}, 'warnings': ['1 file units off']}]
    """
    made = dict(record)
    if "shapes" in record:
        made["shapes"] = {
            i: {**(shape or {}), "stages": [_stage(s) for s in (shape or {}).get("stages") or ()]}
            for i, shape in (record["shapes"] or {}).items()
        }
    if "cohort_stages" in record:
        made["cohort_stages"] = [_stage(s) for s in record["cohort_stages"] or ()]
    if "failures" in record:
        made["failures"] = {i: {k: _text(v) for k, v in f.items()} for i, f in (record["failures"] or {}).items()}
    if "methods" in record:
        made["methods"] = [{**m, "sentence": _text(m.get("sentence", ""))} for m in record["methods"] or ()]
    return made


def _text(value: Any) -> Any:
    return without_mm(value) if isinstance(value, str) else value


def _stage(stage: Mapping[str, Any]) -> dict[str, Any]:
    made = dict(stage)
    if stage.get("metrics"):
        made["metrics"] = {unit_key(key): _text(value) for key, value in stage["metrics"].items()}
    if stage.get("warnings"):
        made["warnings"] = [_text(text) for text in stage["warnings"]]
    return made
