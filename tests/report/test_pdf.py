from __future__ import annotations

import re
import zlib

import pytest

from ssmpipe.core.errors import ConfigError
from ssmpipe.report import pdf
from ssmpipe.report.build import Document, report_document
from ssmpipe.report.figures import as_pixels
from ssmpipe.report.pdf import _grid, parsed, to_pdf
from tests.support.small_run import small_run

pytest.importorskip("reportlab", reason="ReportLab is not installed (pip install 'ssmpipe[pdf]')")


@pytest.fixture(scope="module")
def document() -> Document:
    with as_pixels(60):
        return report_document(**small_run(ids=("P01", "P02", "P03", "P04"), n=11).arguments())


def test_it_is_a_document_of_pages_and_repeats(document: Document) -> None:
    made = to_pdf(document)
    assert made[:5] == b"%PDF-"
    assert len(re.findall(rb"/Type /Page\b", made)) >= 4
    assert to_pdf(document) == made


def test_every_section_but_the_interactive_one_is_set(document: Document, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    plain = pdf._Setter.paragraph
    monkeypatch.setattr(
        pdf._Setter,
        "paragraph",
        lambda self, markup, name, **more: (said.append(markup), plain(self, markup, name, **more))[1],
    )
    to_pdf(document)
    titles = [section.title for section in document.sections if section.key != "model"]
    assert [text for text in said if text in titles] == titles
    assert "The model in 3-D" not in said
    assert any("the surface has 2 handles" in text for text in said)
    assert any("Davies RH" in text for text in said)


def test_hostile_text_is_text(document: Document) -> None:
    run = small_run(ids=("P01", "P02", "P03", "P04"), n=11)
    run.record["failures"]["P99_broken"]["error"] = "</para><img src='/etc/passwd'/> & <b>"
    run.record["name"] = "<img src='/etc/passwd'/>"
    with as_pixels(60):
        attacked = to_pdf(report_document(**run.arguments()))
    assert attacked[:5] == b"%PDF-"
    assert b"root:" not in b"".join(_streams(attacked))


def _streams(made: bytes) -> list[bytes]:
    found = []
    for raw in re.findall(rb"stream\r?\n(.*?)endstream", made, flags=re.DOTALL):
        try:
            found.append(zlib.decompress(raw.strip()))
        except zlib.error:
            found.append(raw)
    return found


def test_cells_that_reach_over_rows_and_columns() -> None:
    table = parsed(
        "<table><tr><th rowspan=2>a</th><th colspan=2>b</th></tr><tr><th>c</th><th>d</th></tr>"
        "<tr><td>1</td><td>2</td><td>3</td></tr></table>"
    )
    grid, spans = _grid(list(table.all("tr")))
    assert [[cell.text() if cell else "" for cell in row] for row in grid] == [
        ["a", "b", ""],
        ["", "c", "d"],
        ["1", "2", "3"],
    ]
    assert spans == [(0, 0, 2, 1), (0, 1, 1, 2)]


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pdf, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"ssmpipe\[pdf\]"):
        to_pdf(Document("a", "b", "c", ()))
