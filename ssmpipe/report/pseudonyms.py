"""Neutral names instead of the ids of patients, everywhere in what a report is made from."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.report.section import to_float

WITHHELD = "(withheld)"
_SHORT = re.compile(r"\d{1,3}|.{1,2}")  # too short to tell from other words and numbers of a sentence
_PATH = re.compile(
    r"[/\\]|\.(ply|stl|obj|off|vtk|vtp|npz|csv|json|fcsv|pp|png|jpe?g|tiff?|bmp|asf|pts|ya?ml)\b", re.IGNORECASE
)
_FOLDER = re.compile(r"^[\"'(]?([A-Za-z]:)?(\.{0,2}[/\\])|[/\\].*[/\\]")
_KEPT_COLUMNS = 8  # different texts of a column that is kept


def assign(ids: Sequence[str], known: Mapping[str, str] | None = None, letter: str = "P") -> dict[str, str]:
    """Return a neutral name for every id: the known ones stay, new ones get the next free numbers in the order of the ids.

    Examples
    --------
    >>> assign(["b", "a"])
    {'a': 'P001', 'b': 'P002'}
    >>> assign(["a", "aa", "b"], {"a": "P001", "b": "P002"})["aa"]
    'P003'
    """
    names = dict(known or {})
    taken = {int(name[1:]) for name in names.values() if re.fullmatch(letter + r"\d+", name)}
    following = max(taken, default=0) + 1
    for one in sorted(set(ids) - set(names)):
        names[one] = f"{letter}{following:03d}"
        following += 1
    return names


@dataclass(frozen=True)
class Pseudonyms:
    """The names to use instead of ids.

    Parameters
    ----------
    names : mapping id -> neutral name
    subjects : mapping
        Neutral names of the values of the column ``subject``.
    words : tuple of (str, str)
        Other words (file names) and what stands for them.
    """

    names: Mapping[str, str]
    subjects: Mapping[str, str]
    words: tuple[tuple[str, str], ...] = ()

    def text(self, text: str) -> str:
        """Return a sentence with all ids, subjects and file names replaced; paths are withheld.

        An id of one or two characters, or a number below 1000, cannot be told from other words and stays.

        Examples
        --------
        >>> Pseudonyms({"smith_01": "P001"}, {}, (("smith_01.stl", "P001"),)).text("smith_01.stl of smith_01, not smith_012")
        'P001 of P001, not smith_012'
        """
        pairs = dict([*self.subjects.items(), *self.names.items(), *self.words])
        longest = sorted((word for word in pairs if word and not _SHORT.fullmatch(word)), key=len, reverse=True)
        if not longest:
            return text
        pattern = r"(?<![A-Za-z0-9_])(" + "|".join(map(re.escape, longest)) + r")(?![A-Za-z0-9_])"
        return re.sub(pattern, lambda found: pairs[found[1]], text)

    def anything(self, value: Any, *, paths: bool = False) -> Any:
        """Return plain data with every text replaced; with ``paths``, texts that look like a path are withheld."""
        if isinstance(value, str):
            if value in self.names:
                return self.names[value]
            return WITHHELD if paths and _PATH.search(value) else self.text(value)
        if isinstance(value, Mapping):
            return {
                self.names.get(key, self.text(str(key))): self.anything(item, paths=paths)
                for key, item in value.items()
            }
        if isinstance(value, (list, tuple)):
            return [self.anything(item, paths=paths) for item in value]
        return value

    def keyed(self, mapping: Mapping[str, Any], change: Callable[[Any], Any] | None = None) -> dict[str, Any]:
        """Return a mapping by id with neutral names as keys, in their order."""
        made = {
            self.names[key]: (change or self.anything)(value) for key, value in mapping.items() if key in self.names
        }
        return dict(sorted(made.items()))

    def record(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return the record of a run without anything that names a patient, a file or a folder."""
        shapes = record.get("shapes") or {}
        columns = _columns(shapes)
        made = {key: value for key, value in record.items() if key in ("ssmpipe_version", "versions", "seed")}
        made["name"] = self.text(str(record.get("name") or ""))
        made["config"] = self.anything(record.get("config") or {}, paths=True)
        made["cohort_stages"] = [self._stage(stage) for stage in record.get("cohort_stages") or ()]
        made["methods"] = [
            {**step, "sentence": self.text(str(step.get("sentence", "")))} for step in record.get("methods") or ()
        ]
        failures = record.get("failures") or {}
        made["failures"] = {
            self.names.get(key, key): {k: self._message(v) for k, v in failure.items() if k != "file"}
            for key, failure in failures.items()
        }
        made["shapes"] = self.keyed(shapes, lambda shape: self._shape(shape, columns))
        return made

    def _message(self, text: Any) -> Any:
        if not isinstance(text, str):
            return self.anything(text)
        return " ".join(WITHHELD if _FOLDER.search(word) else word for word in self.text(text).split(" "))

    def _shape(self, shape: Mapping[str, Any], columns: Mapping[str, str]) -> dict[str, Any]:
        info = {}
        for name, value in (shape.get("info") or {}).items():
            if name == "subject" and value:
                info[name] = self.subjects[str(value)]
            elif columns.get(name) == "kept":
                info[name] = value
        stages = [self._stage(stage) for stage in shape.get("stages") or ()]
        return {"file": "", "info": info, "stages": stages}

    def _stage(self, stage: Mapping[str, Any]) -> dict[str, Any]:
        made: dict[str, Any] = self.anything(stage)
        for key in ("warnings", "reason"):
            if key in stage:
                texts = stage[key]
                made[key] = [self._message(text) for text in texts] if key == "warnings" else self._message(texts)
        return made

    def table(self, table: Table | None) -> Table | None:
        """Return a table with the ids in its column ``id`` replaced."""
        if table is None or "id" not in table.columns:
            return table
        columns = {**table.columns, "id": [self.names[str(i)] for i in table.columns["id"]]}
        return Table(columns, table.comment)

    def ids(self, ids: Sequence[str]) -> tuple[str, ...]:
        """Return the names of several ids, in their order."""
        return tuple(self.names[str(i)] for i in ids)

    def results(self, artifacts: Mapping[str, Any]) -> dict[str, Any]:
        """Return the results of the group stages, by slot, with names instead of ids."""
        made = dict(artifacts)
        for slot, value in artifacts.items():
            if isinstance(value, (Correspondence, ShapeModel)):
                made[slot] = replace(value, ids=self.ids(value.ids))
            elif isinstance(value, Table):
                made[slot] = self.table(value)
            elif slot == "reconstructions" and value is not None:
                made[slot] = {**value, "ids": np.array(self.ids(value["ids"]))}
            elif slot == "certificate" and value:
                made[slot] = {
                    **{key: item for key, item in self.anything(value).items() if key != "shapes"},
                    "shapes": self.keyed(value.get("shapes") or {}),
                }
        return made


def _columns(shapes: Mapping[str, Any]) -> dict[str, str]:
    """Say of every column of the cohort table whether it is kept: numbers and groups are, names and dates are not."""
    values: dict[str, list[str]] = {}
    for shape in shapes.values():
        for name, value in (shape.get("info") or {}).items():
            if value not in (None, ""):
                values.setdefault(name, []).append(str(value))
    return {name: "kept" if _harmless(column) else "withheld" for name, column in values.items()}


def _harmless(column: Sequence[str]) -> bool:
    numbers = np.array([to_float(value) for value in column])
    if np.isfinite(numbers).all():
        record_numbers = (
            (numbers == numbers.round()).all() and numbers.max() >= 10000 and len(set(column)) == len(column)
        )
        return not record_numbers
    different = len(set(column))
    return (
        different <= _KEPT_COLUMNS
        and different < max(len(column), 2)
        and not any(_PATH.search(value) for value in column)
    )


def make_pseudonyms(
    record: Mapping[str, Any], known: Mapping[str, str], known_subjects: Mapping[str, str]
) -> Pseudonyms:
    """Return the names for all shapes of a record; ``known`` ones stay as they are."""
    shapes = record.get("shapes") or {}
    names = assign(list(shapes), known)
    subjects = [str(s["info"]["subject"]) for s in shapes.values() if (s.get("info") or {}).get("subject")]
    words = []
    for key, shape in shapes.items():
        file = str(shape.get("file") or "")
        words += [(word, names[key]) for word in (file, file.rsplit(".", 1)[0]) if word]
    return Pseudonyms(names, assign(subjects, known_subjects, "S"), tuple(words))
