"""The report as it is given away: with neutral names, or as one PDF file for print."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.config import Project
from ssmpipe.runner.disk import disk_errors, write_atomically, write_bytes_atomically
from ssmpipe.runner.lock import locked
from ssmpipe.runner.patients import FOLDER, landmarks_of, page_name
from ssmpipe.runner.record import read_failures, report_record, run_record
from ssmpipe.runner.registry import REPORT
from ssmpipe.runner.run import machine, make_workspace

if TYPE_CHECKING:
    from ssmpipe.report.build import Document
    from ssmpipe.report.pseudonyms import Pseudonyms

SHARED = "report_pseudonymized"
KEY = "pseudonyms.csv"
Format = Literal["html", "pdf"]


def share_report(project: Project, *, form: Format = "html", pseudonymize: bool = False) -> tuple[Path, Path | None]:
    """Write the report from what is in the output folder: as a PDF file, or with neutral names, or both.

    Parameters
    ----------
    project : Project
    form : {"html", "pdf"}
        html: the page and the pages of all shapes; pdf: the part of the page that is not interactive.
    pseudonymize : bool
        Write into a folder of its own, with P001 ... instead of ids. The table of names stands beside that folder, not in it;
        names once given are kept.

    Returns
    -------
    Path
        What was written.
    Path or None
        The table of names.

    Raises
    ------
    ConfigError
        If the chain has no report stage, or the library for PDF is not installed.
    SsmpipeError
        If the group stages have not been run.
    """
    from ssmpipe.report.patient import build_patient
    from ssmpipe.report.pdf import require_pdf
    from ssmpipe.runner.reporting import NAME, report_of, results_of, shape_page

    step = next((s for s in project.plan.steps if s.stage == REPORT), None)
    if step is None:
        raise ConfigError("this chain has no stage 'report'", "add '- report' to stages")
    with locked(project.out):
        workspace = make_workspace(project)
        shown = report_record(run_record(project, workspace, read_failures(project.out), {}, {}, machine()))
        workspace.input_digests(step, None, ())  # says what has not been made yet
        artifacts = results_of(workspace, step)
        if form == "pdf":
            require_pdf()
        marks: Mapping[str, Any] = landmarks_of(workspace, step, artifacts["correspondence"])
        if not pseudonymize:
            target = project.out / "report.pdf"
            _write_pdf(target, lambda: report_of(shown, artifacts, marks, {}))
            return target, None
        key = project.out / KEY
        names = _names(shown, key)
        hidden, results, hidden_marks = names.record(shown), names.results(artifacts), names.keyed(marks, lambda m: m)
        folder = project.out / SHARED
        if form == "pdf":
            target = folder / "report.pdf"
            _write_pdf(target, lambda: report_of(hidden, results, hidden_marks, {}))
        else:
            target = folder / NAME
            pages = {name: f"{FOLDER}/{page_name(name)}" for name in hidden["shapes"]}
            write_atomically(target, report_of(hidden, results, hidden_marks, pages).html())
            for shape in shown["shapes"]:
                page = shape_page(shape, shown, artifacts, workspace, marks)
                text = build_patient(page.renamed(names, hidden, results))
                write_atomically(folder / FOLDER / page_name(names.names[shape]), text)
            with disk_errors():
                for path in (folder / FOLDER).iterdir():
                    if path.name not in {page_name(name) for name in hidden["shapes"]}:
                        path.unlink()
        return target, key


def _names(shown: Mapping[str, Any], key: Path) -> Pseudonyms:
    """Return the names to use, and write the table of them; names of an earlier table stay."""
    from ssmpipe.report.pseudonyms import make_pseudonyms

    known: dict[str, dict[str, str]] = {"shape": {}, "subject": {}}
    with contextlib.suppress(FileNotFoundError):
        for row in csv.DictReader(io.StringIO(key.read_text(encoding="utf-8"))):
            known.setdefault(row["kind"], {})[row["original"]] = row["pseudonym"]
    names = make_pseudonyms(shown, known["shape"], known["subject"])
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["pseudonym", "kind", "original"])
    for kind, pairs in (("shape", names.names), ("subject", names.subjects)):
        table.writerows(sorted([name, kind, original] for original, name in pairs.items()))
    write_atomically(key, text.getvalue())
    with contextlib.suppress(OSError):
        key.chmod(0o600)
    return names


def _write_pdf(path: Path, make: Callable[[], Document]) -> None:
    from ssmpipe.report.figures import as_pixels
    from ssmpipe.report.pdf import DPI, to_pdf

    with as_pixels(DPI):
        document = make()
    write_bytes_atomically(path, to_pdf(document))
