"""The page that lists all patients of one call of ``project`` with their key numbers, the most unusual first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.report.build import assemble
from ssmpipe.report.page import fill
from ssmpipe.report.projected import is_number
from ssmpipe.report.section import Section
from ssmpipe.report.sections.summary import Tile
from ssmpipe.report.wording import count, number


@dataclass(frozen=True, eq=False)
class ProjectedIndex:
    """What the list of projected patients shows.

    Parameters
    ----------
    name, unit, version, model_name : str
        ``unit`` of the lengths.
    numbers : mapping of mapping
        By id, what ``projection.json`` says.
    files : mapping of str
        Name of the scan by id, of those that failed as well.
    pages : mapping of str
        Address of the page by id, where there is one.
    mahalanobis, residuals : (n_S,)
        Of the training shapes, each in the model of the others.
    warnings : mapping of sequence of (str, str)
        Stage and sentence, by id.
    failures : mapping of mapping
        Stage, error and remedy by id.
    """

    name: str
    unit: str
    version: str
    model_name: str
    numbers: Mapping[str, Mapping[str, Any]]
    files: Mapping[str, str]
    pages: Mapping[str, str]
    mahalanobis: Floats
    residuals: Floats
    warnings: Mapping[str, Sequence[tuple[str, str]]] = field(default_factory=dict)
    failures: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def ids(self) -> list[str]:
        """Ids of the patients that came through, the farthest from the mean first."""
        return sorted(self.numbers, key=lambda i: (-float(self.numbers[i]["mahalanobis"]), i))

    @property
    def unusual(self) -> list[str]:
        """Those that lie farther out than every training shape."""
        least = 1 / (len(self.mahalanobis) + 1)
        return [i for i in self.ids if self.numbers[i]["mahalanobis_p"] <= least]


def build_index(index: ProjectedIndex) -> str:
    """Return the list as one HTML document that works offline; the same input gives the same text."""
    n = len(index.numbers)
    return assemble(
        name=index.name,
        about=f"{count(n, 'shape')} in the model {index.model_name} of {count(len(index.mahalanobis), 'shape')}",
        version=index.version,
        sections=[_summary(index), *([_patients(index)] if n else [])],
        kind="Projected patients",
    )


def _summary(index: ProjectedIndex) -> Section:
    n, n_failed = len(index.numbers), len(index.failures)
    tone = "bad" if n_failed else "good"
    tiles = [Tile(f"{n} of {n + n_failed}", "projected", "" if n_failed else "none was refused", tone)]
    if n:
        found = [float(index.numbers[i]["mahalanobis"]) for i in index.ids]
        remark = f"{number(min(found))} to {number(max(found))}; training shapes {_usual(index.mahalanobis)}"
        tiles.append(Tile(number(float(np.median(found))), "Mahalanobis distance, median", remark))
        remark = "than every training shape in the model of the others"
        tiles.append(Tile(str(len(index.unusual)), "farther out", remark, "bad" if index.unusual else ""))
        residuals = [float(row["residual_rms_mm"]) for row in index.numbers.values() if "residual_rms_mm" in row]
        if residuals:
            remark = f"root mean square; training shapes {_usual(index.residuals)}"
            tiles.append(Tile(f"{number(float(np.median(residuals)))} {index.unit}", "residual, median", remark))
    warned = sum(len(index.warnings.get(i, ())) for i in index.ids)
    tiles.append(Tile(str(warned), "warning" if warned == 1 else "warnings"))
    failed = {i: index.failures[i] for i in sorted(index.failures)}
    html = fill("projected_index_summary.html.j2", tiles=tiles, failed=failed, files=index.files)
    return Section("summary", "Summary", html)


def _usual(values: Floats) -> str:
    return f"{number(float(np.median(values)))}, at most {number(float(values.max()))}" if len(values) else "unknown"


def _patients(index: ProjectedIndex) -> Section:
    rows = []
    for i in index.ids:
        told = index.numbers[i]
        rows.append(
            {
                "id": i,
                "page": index.pages.get(i),
                "side": told.get("side"),
                "unusual": i in index.unusual,
                "status": told["certificate"]["status"],
                "warnings": index.warnings.get(i, ()),
                **{name: told[name] for name in ("mahalanobis", "mahalanobis_p")},
                **{name: told.get(name) for name in ("residual_rms_mm", "residual_p", "expected_error_mm")},
                **{name: told.get(name) if is_number(told.get(name)) else None for name in ("from_scan_mean_mm", "from_scan_p95_mm")},
                "seen": f"{100 * told['seen_share']:.0f}" if "seen_share" in told else None,
                "holes": told.get("holes_left") or 0,
            }
        )  # fmt: skip
    parts = any(row["seen"] is not None for row in rows)
    html = fill("projected_index.html.j2", rows=rows, parts=parts, unit=index.unit, n_training=len(index.mahalanobis))
    return Section("patients", "Patients", html)
