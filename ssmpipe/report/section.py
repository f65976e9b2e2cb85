"""What a section gets and what it gives: the frame that the report grows in.

A section is one file under ``sections/`` with one function ``render(data: ReportData) -> Section | None`` and one line in
``sections/__init__.py``. ``None`` leaves the section out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.report.units import FILE_UNITS


@dataclass(frozen=True)
class Section:
    """One part of the page: ``key`` is its anchor, ``title`` its heading, ``html`` its escaped content."""

    key: str
    title: str
    html: Markup


@dataclass(frozen=True)
class ReportData:
    """Everything a section may draw: the artifacts of the cohort stages and the record of the run.

    ``landmarks`` are in the frame of the correspondence; ``pages`` are addresses of the pages of single shapes, by id.
    """

    record: Mapping[str, Any]
    correspondence: Correspondence
    model: ShapeModel
    measures: Table
    landmark_transfer: Table | None
    history: Table
    certificate: Mapping[str, Any]
    quality: Table | None = None
    landmarks: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    pages: Mapping[str, str] = field(default_factory=dict)

    @property
    def unit(self) -> str:
        """Unit of length that the numbers are in ("mm", or "file units" when the config says ``units: none``)."""
        config = self.record.get("config") or {}
        given = config.get("input") if isinstance(config, Mapping) else None
        units = given.get("units") if isinstance(given, Mapping) else None
        return FILE_UNITS if units == "none" else "mm"

    @property
    def failures(self) -> Mapping[str, Any]:
        """Shapes that were set aside: id -> {stage, error, remedy}."""
        return self.record.get("failures") or {}

    @property
    def shapes(self) -> Mapping[str, Any]:
        """Shapes of the record, sorted by id."""
        shapes = self.record.get("shapes") or {}
        return {key: shapes[key] or {} for key in sorted(shapes)}


@dataclass(frozen=True)
class Group:
    """Rows of a table that belong to one correspondence, as float columns."""

    name: str
    columns: Mapping[str, Sequence[float]] = field(default_factory=dict)


def by_correspondence(table: Table) -> list[Group]:
    """Split a table by its column ``correspondence``: initial first, optimized second, others in order of appearance.

    Examples
    --------
    >>> table = Table({"correspondence": ["optimized", "initial"], "n_modes": [1, 1]})
    >>> [group.name for group in by_correspondence(table)]
    ['initial', 'optimized']
    """
    columns = table.columns
    names = [str(name) for name in columns.get("correspondence", ())]
    order = {"initial": 0, "optimized": 1}
    groups = []
    for name in sorted(dict.fromkeys(names), key=lambda name: order.get(name, 2)):
        rows = [i for i, other in enumerate(names) if other == name]
        kept = {key: [column[i] for i in rows] for key, column in columns.items() if key != "correspondence"}
        groups.append(Group(name, {key: [to_float(x) for x in column] for key, column in kept.items()}))
    return groups


def to_float(value: Any) -> float:
    """Return ``value`` as a float, NaN when it is not a number.

    Examples
    --------
    >>> to_float("1.5"), to_float("n/a")
    (1.5, nan)
    """
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
