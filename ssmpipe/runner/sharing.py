"""The report as it is given away: with neutral names, or as one PDF file for print."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import disk_errors, write_atomically, write_bytes_atomically
from ssmpipe.runner.lock import locked
from ssmpipe.runner.machine import machine
from ssmpipe.runner.pages import for_report, make_pages, results_of
from ssmpipe.runner.patients import FOLDER, landmarks_of, page_name
from ssmpipe.runner.project import Project
from ssmpipe.runner.record import read_failures, report_record, run_record
from ssmpipe.runner.registry import REPORT

if TYPE_CHECKING:
    from ssmpipe.report.build import Document
    from ssmpipe.report.pseudonyms import Pseudonyms

SHARED = "report_pseudonymized"
KEY = "pseudonyms.csv"
_COLUMNS = ("pseudonym", "kind", "original")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # becomes the name of a file
_RESTORE = "mend the table, or move it away: then all names are given anew"
Format = Literal["html", "pdf"]


def share_report(
    project: Project,
    *,
    form: Format = "html",
    pseudonymize: bool = False,
    jobs: int | None = None,
    console: Console | None = None,
) -> tuple[Path, Path | None]:
    """Write the report from what is in the output folder: as a PDF file, or with neutral names, or both.

    Parameters
    ----------
    project : Project
    form : {"html", "pdf"}
        html: the page and the pages of all shapes; pdf: the part of the page that is not interactive.
    pseudonymize : bool
        Write into a folder of its own, with P001 ... instead of ids. The table of names stands beside that folder, not in it;
        names once given are kept.
    jobs : int, optional
        Children that write the pages.
    console : Console, optional
        Told of pages that could not be made.

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
    from ssmpipe.report.pdf import require_pdf
    from ssmpipe.runner.reporting import NAME, report_of

    step = next((s for s in project.plan.steps if s.stage == REPORT), None)
    if step is None:
        raise ConfigError("this chain has no stage 'report'", "add '- report' to stages")
    console = console or Console()
    with locked(project.out), for_report(project, jobs, console) as (workspace, batch):
        shown = report_record(run_record(project, workspace, read_failures(project.out), {}, {}, machine()))
        workspace.input_digests(step, None, ())  # says what has not been made yet
        artifacts = results_of(workspace, step)
        if form == "pdf":
            require_pdf()
        marks: Mapping[str, Any] = landmarks_of(workspace, step, artifacts["correspondence"], console.warn)
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
            ids = list(shown["shapes"])
            failed = make_pages(batch, workspace, ids, shown, folder / FOLDER, console.warn, names)
            made = sorted(names.names[i] for i in ids if i not in failed)
            pages = {name: f"{FOLDER}/{page_name(name)}" for name in made}
            write_atomically(target, report_of(hidden, results, hidden_marks, pages).html())
            with disk_errors():
                for path in (folder / FOLDER).iterdir():
                    if path.name not in {page_name(name) for name in made}:
                        path.unlink()
        return target, key


def _names(shown: Mapping[str, Any], key: Path) -> Pseudonyms:
    """Return the names to use, and write the table of them; names of an earlier table stay."""
    from ssmpipe.report.pseudonyms import make_pseudonyms

    known = _known(key)
    names = make_pseudonyms(shown, known["shape"], known["subject"])
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    for kind, pairs in (("shape", names.names), ("subject", names.subjects)):
        table.writerows(sorted([name, kind, original] for original, name in pairs.items()))
    write_atomically(key, text.getvalue(), mode=0o600)
    return names


def _known(key: Path) -> dict[str, dict[str, str]]:
    """Return the names of an earlier table, {kind: {original: pseudonym}}; none when there is no table.

    Raises
    ------
    ConfigError
        If the table was edited so that it says nothing, or two things, of somebody: names must not silently change hands.
    """
    known: dict[str, dict[str, str]] = {"shape": {}, "subject": {}}
    try:
        rows = list(csv.reader(io.StringIO(key.read_text(encoding="utf-8-sig"))))
    except FileNotFoundError:
        return known
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{key} is not the table that ssmpipe wrote ({error})", _RESTORE) from None
    if not rows or tuple(rows[0]) != _COLUMNS:
        raise ConfigError(f"{key}: the first line must be {','.join(_COLUMNS)}", _RESTORE)
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        if len(row) != len(_COLUMNS) or row[1] not in known or not _NAME.fullmatch(row[0]) or not row[2]:
            raise ConfigError(
                f"{key}, line {number}: not a pseudonym, shape or subject, and an original name", _RESTORE
            )
        pseudonym, kind, original = row
        if original in known[kind] or pseudonym in known[kind].values():
            raise ConfigError(f"{key}, line {number}: '{pseudonym}' or its original name is there twice", _RESTORE)
        known[kind][original] = pseudonym
    return known


def _write_pdf(path: Path, make: Callable[[], Document]) -> None:
    from ssmpipe.report.figures import as_pixels
    from ssmpipe.report.pdf import DPI, to_pdf

    with as_pixels(DPI):
        document = make()
    write_bytes_atomically(path, to_pdf(document))
