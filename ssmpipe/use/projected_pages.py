"""The page of a projected patient and the list of all: where they stand, and what they say besides the patient's numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ssmpipe import __version__
from ssmpipe.report.projected import ProjectedPage, build_projected
from ssmpipe.report.projected_index import ProjectedIndex
from ssmpipe.runner.disk import write_atomically
from ssmpipe.runner.sources import Source
from ssmpipe.use.projected_results import ProjectResult
from ssmpipe.use.target import Target


def page_path(out: Path, shape: str) -> Path:
    """Return where the page of one patient is written."""
    return out / f"{shape}.html"


def write_page(out: Path, shape: str, make: Callable[[], ProjectedPage]) -> list[str]:
    """Write the page of one patient; return a warning where that cannot be done, since the numbers are there all the same."""
    try:
        text = build_projected(make())
    except Exception as error:
        return [f"its page could not be made ({type(error).__name__}: {error}); the numbers are in patients/{shape}"]
    write_atomically(page_path(out, shape), text)
    return []


def about(target: Target, source: Source) -> dict[str, Any]:
    """Return what the pages of scans and of fragments have in common."""
    return {
        "id": source.id,
        "file": source.path.name,
        "side": source.side or "",
        "unit": target.unit,
        "version": __version__,
        "model_name": target.name,
        "model": target.model,
        "mahalanobis": target.others.mahalanobis,
        "residuals": target.residuals,
    }


def index_of(
    out: Path,
    target: Target,
    sources: Sequence[Source],
    result: ProjectResult,
    failures: Mapping[str, Mapping[str, str]],
) -> ProjectedIndex:
    """Return what the list of all patients shows; ``failures`` as in ``failures.json``."""
    return ProjectedIndex(
        name=out.resolve().name,
        unit=target.unit,
        version=__version__,
        model_name=target.name,
        numbers=result.rows,
        files={source.id: source.path.name for source in sources},
        pages={i: page_path(out, i).name for i in result.rows if page_path(out, i).is_file()},
        mahalanobis=target.others.mahalanobis,
        residuals=target.residuals,
        warnings=result.warnings,
        failures=failures,
    )
