"""The report: one HTML page that asks nothing of the network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.report.page import fill, resource
from ssmpipe.report.section import ReportData, Section
from ssmpipe.report.sections import SECTIONS
from ssmpipe.report.units import record_without_mm
from ssmpipe.report.wording import count, number


@dataclass(frozen=True)
class Document:
    """A page before it is made into HTML or PDF: its title, a line about it, and its sections."""

    name: str
    about: str
    version: str
    sections: tuple[Section, ...]

    def html(self) -> str:
        """Return the page as one HTML document."""
        return assemble(name=self.name, about=self.about, version=self.version, sections=self.sections)


def build_report(**given: Any) -> str:
    """Return the report of a run as one HTML document that works offline; arguments as :func:`report_document`.

    Returns
    -------
    str
        The same input gives the same text. The page's content security policy lets exactly its own script and style run
        (by their SHA-256) and nothing be fetched.
    """
    return report_document(**given).html()


def report_document(
    *,
    record: Mapping[str, Any],
    correspondence: Correspondence,
    model: ShapeModel,
    measures: Table,
    landmark_transfer: Table | None = None,
    history: Table,
    certificate: Mapping[str, Any],
    quality: Table | None = None,
    landmarks: Mapping[str, Mapping[str, Floats]] | None = None,
    pages: Mapping[str, str] | None = None,
) -> Document:
    """Return the report of a run.

    Parameters
    ----------
    record : dict
        What the runner knows: name, versions, config, ``shapes`` with their stages, ``cohort_stages``, ``failures``,
        ``methods``. Missing keys leave their part out.
    correspondence, model
        Results of the group stages.
    measures : Table
        One row per correspondence and number of modes.
    landmark_transfer : Table, optional
        Distances between carried and marked landmarks.
    history : Table
        One row per iteration of the optimizer.
    certificate : dict
        ``{"shapes": {id: {"lower_bound", "status", "method"}}}``.
    quality : Table, optional
        Distances of every shape to its reconstruction from the others, worst first.
    landmarks : mapping id -> name -> (d,), optional
        Marked landmarks in the frame of the correspondence.
    pages : mapping id -> address, optional
        Pages of the single shapes, linked where the shape is named.
    """
    if (record.get("config") or {}).get("input", {}).get("units") == "none":
        record = record_without_mm(record)
    data = ReportData(
        record,
        correspondence,
        model,
        measures,
        landmark_transfer,
        history,
        certificate,
        quality,
        landmarks or {},
        pages or {},
    )
    sections = [section for render in SECTIONS if (section := render(data)) is not None]
    name = str(record.get("name") or "Shape model")
    about = f"{count(len(model.ids), 'shape')}, {number(len(model.mean))} points each, {count(len(model.modes), 'mode')} of variation"
    name = name[:1].upper() + name[1:]
    return Document(name, about, str(record.get("ssmpipe_version", "")), tuple(sections))


def assemble(
    *,
    name: str,
    about: str,
    version: str,
    sections: Sequence[Section],
    kind: str = "Statistical shape model",
    links: Sequence[tuple[str, str]] = (),
) -> str:
    """Return a page of sections with the style and the viewer of the report, and the policy that lets only these run.

    ``links`` are addresses and names of neighbouring pages.
    """
    style, script = resource("templates", "report.css"), resource("assets", "viewer.js")
    return str(
        fill(
            "report.html.j2",
            name=name,
            links=links,
            kind=kind,
            about=about,
            version=version,
            sections=sections,
            style=Markup(style),
            script=Markup(script),
            policy=f"default-src 'none'; script-src '{_sha256(script)}'; style-src '{_sha256(style)}'; img-src data:; "
            "base-uri 'none'; form-action 'none'",
        )
    )


def _sha256(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
