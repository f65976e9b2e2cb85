"""The report for print: the parts that are not interactive, as one PDF file.

Reads the HTML of the sections, which this package has written itself and which uses few elements, and sets it with ReportLab.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from ssmpipe.core.errors import ConfigError
from ssmpipe.report.build import Document

DPI = 200
_VOID = {"img", "br", "input", "hr", "meta", "link"}
_SKIPPED = {"script", "style", "select", "button", "canvas", "nav", "input", "output"}
_INLINE = {
    "b": "b",
    "strong": "b",
    "em": "i",
    "i": "",
    "small": "small",
    "sub": "sub",
    "sup": "super",
    "span": "",
    "a": "",
    "code": "",
}
_INK, _MUTED, _LINE, _SOFT = "#1c2733", "#5d6975", "#dfe4e9", "#f4f6f8"
_TONES = {"good": "#2c6e49", "bad": "#a33a2a"}


def require_pdf() -> None:
    """Say what to install when the library is not there.

    Raises
    ------
    ConfigError
    """
    if find_spec("reportlab") is None:
        raise ConfigError("a PDF needs the library ReportLab, which is not installed", 'pip install "ssmpipe[pdf]"')


@dataclass
class Node:
    """An element with its attributes and its children, which are elements or text."""

    tag: str
    attributes: dict[str, str]
    children: list[Node | str] = field(default_factory=list)

    @property
    def classes(self) -> set[str]:
        """Names in the attribute ``class``."""
        return set(self.attributes.get("class", "").split())

    def all(self, *tags: str) -> Iterator[Node]:
        """Elements of these kinds inside, in order."""
        for child in self.children:
            if isinstance(child, Node):
                if child.tag in tags:
                    yield child
                yield from child.all(*tags)

    def text(self) -> str:
        """All text inside, blanks made single."""
        return " ".join("".join(c if isinstance(c, str) else c.text() for c in self.children).split())


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.root = Node("root", {})
        self.open = [self.root]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        node = Node(tag, {key: value or "" for key, value in attrs})
        self.open[-1].children.append(node)
        if tag not in _VOID:
            self.open.append(node)

    def handle_endtag(self, tag: str) -> None:
        if any(node.tag == tag for node in self.open):
            while self.open.pop().tag != tag:
                pass

    def handle_data(self, data: str) -> None:
        self.open[-1].children.append(data)


def parsed(html: str) -> Node:
    """Return the elements of a piece of HTML.

    Examples
    --------
    >>> [n.tag for n in parsed("<p>a <b>c</b></p><img src='x'>").all("p", "b", "img")]
    ['p', 'b', 'img']
    """
    reader = _Reader()
    reader.feed(html)
    return reader.root


def to_pdf(document: Document) -> bytes:
    """Return a document as PDF (A4); the same document gives the same bytes.

    Raises
    ------
    ConfigError
        If ReportLab is not installed.
    """
    require_pdf()
    from reportlab.lib.pagesizes import A4
    from reportlab.platypus import BaseDocTemplate, Frame, PageTemplate

    setter = _Setter()
    story = [setter.paragraph(escape(document.name), "title"), setter.paragraph(escape(document.about), "note")]
    for section in document.sections:
        content = list(setter.blocks(parsed(str(section.html))))
        if content:
            story += [setter.paragraph(escape(section.title), "h2"), *content]
    out = io.BytesIO()
    left, bottom = 42.0, 46.0
    made = BaseDocTemplate(
        out,
        pagesize=A4,
        title=document.name,
        creator=f"ssmpipe {document.version}",
        author="",
        invariant=1,
        pageCompression=1,
    )
    frame = Frame(left, bottom, A4[0] - 2 * left, A4[1] - 2 * bottom, 0, 0, 0, 0)

    def footer(canvas: Any, template: Any) -> None:
        canvas.setFont(setter.regular, 7)
        canvas.setFillColor(_MUTED)
        canvas.drawString(left, 26, f"{document.name} · ssmpipe {document.version}")
        canvas.drawRightString(A4[0] - left, 26, str(template.page))

    made.addPageTemplates([PageTemplate(frames=[frame], onPage=footer)])
    made.build(story)
    return out.getvalue()


class _Setter:
    """Turns elements into what ReportLab sets; widths in points."""

    width = 511.0

    def __init__(self) -> None:
        from matplotlib import get_data_path
        from reportlab.lib.styles import ParagraphStyle
        from reportlab.pdfbase import pdfmetrics
        from reportlab.pdfbase.ttfonts import TTFont

        folder = Path(get_data_path()) / "fonts" / "ttf"
        self.regular, self.bold = "ssmpipe-sans", "ssmpipe-sans-bold"
        for name, file in (
            (self.regular, "DejaVuSans.ttf"),
            (self.bold, "DejaVuSans-Bold.ttf"),
            ("ssmpipe-sans-italic", "DejaVuSans-Oblique.ttf"),
            ("ssmpipe-mono", "DejaVuSansMono.ttf"),
        ):
            pdfmetrics.registerFont(TTFont(name, str(folder / file)))
        pdfmetrics.registerFontFamily(self.regular, self.regular, self.bold, "ssmpipe-sans-italic", self.bold)

        def style(name: str, size: float, **more: Any) -> Any:
            return ParagraphStyle(
                name,
                fontName=more.pop("font", self.regular),
                fontSize=size,
                leading=1.42 * size,
                textColor=more.pop("colour", _INK),
                **more,
            )

        self.styles = {
            "title": style("title", 20, font=self.bold, spaceAfter=4),
            "h2": style("h2", 13, font=self.bold, spaceBefore=20, spaceAfter=6, keepWithNext=1),
            "h3": style("h3", 9.5, font=self.bold, spaceBefore=9, spaceAfter=3, keepWithNext=1),
            "p": style("p", 8.6, spaceAfter=4),
            "lead": style("lead", 8.6, colour=_MUTED, spaceAfter=6),
            "note": style("note", 7.6, colour=_MUTED, spaceAfter=4),
            "alert": style("alert", 8.6, colour=_TONES["bad"], spaceAfter=3),
            "caption": style("caption", 6.8, colour=_MUTED, alignment=1),
            "list": style("list", 8, leftIndent=16, bulletIndent=2, spaceAfter=2),
            "code": style("code", 6.2, font="ssmpipe-mono", backColor=_SOFT, borderPadding=4),
        }

    def paragraph(self, markup: str, name: str, **more: Any) -> Any:
        from reportlab.platypus import Paragraph

        return Paragraph(markup, self.styles[name], **more)

    def blocks(self, node: Node, name: str = "p") -> Iterator[Any]:
        """Set the children of an element."""
        if "alert" in node.classes or "warnings" in node.classes:
            name = "alert" if "alert" in node.classes else name
        for child in node.children:
            if isinstance(child, str):
                if child.strip():
                    yield self.paragraph(escape(" ".join(child.split())), name)
            elif not (child.tag in _SKIPPED or child.classes & {"screen", "print"}):
                yield from self.block(child, name)

    def block(self, node: Node, name: str) -> Iterator[Any]:
        """Set one element."""
        handlers: dict[str, Callable[[Node, str], Iterator[Any]]] = {
            "p": self._text, "h3": self._heading, "ul": self._list, "ol": self._list, "dl": self._tiles, "table": self._table,
            "figure": self._figure, "pre": self._code, "details": self._details, "img": self._picture,
        }  # fmt: skip
        if node.tag in handlers:
            yield from handlers[node.tag](node, name)
        elif node.classes & {"tilesheet", "triple"}:
            yield self._sheet(node, 5 if "tilesheet" in node.classes else 3)
        elif node.tag in _INLINE:
            yield self.paragraph(self.markup(node), name)
        elif node.classes & {"caution"}:
            yield self.paragraph(self.markup(node), "note")
        else:
            yield from self.blocks(node, name)

    def markup(self, node: Node) -> str:
        """Return the text of an element with its bold and italic parts, as ReportLab reads it."""
        parts = []
        for child in node.children:
            if isinstance(child, str):
                parts.append(escape(" ".join(child.split()) if child.strip() else " "))
                if child[:1].isspace() and len(parts) > 1:
                    parts[-1] = " " + parts[-1].lstrip()
                if child[-1:].isspace():
                    parts[-1] = parts[-1].rstrip() + " "
            elif child.tag == "br":
                parts.append("<br/>")
            elif child.tag not in _SKIPPED and child.tag != "img":
                inside, tag = self.markup(child), _INLINE.get(child.tag, "")
                if tag == "small":
                    inside = f'<font color="{_MUTED}">{inside}</font>'
                elif tag:
                    inside = f"<{tag}>{inside}</{tag}>"
                parts.append(inside)
        return "".join(parts)

    def _text(self, node: Node, name: str) -> Iterator[Any]:
        pictures = list(node.all("img"))
        if pictures:  # a colour scale between its ends
            words = [n.text() for n in node.all("i", "span")]
            yield self._row([*words[:-1], self._image(pictures[0], 120, 7), words[-1]] if words else [])
            return
        own = next((key for key in ("lead", "note") if key in node.classes), name)
        yield self.paragraph(self.markup(node), own)

    def _row(self, cells: list[Any]) -> Any:
        from reportlab.platypus import Table

        made = [c if not isinstance(c, str) else self.paragraph(escape(c), "note") for c in cells]
        widths = [c.drawWidth + 4 if not isinstance(c, str) else 12 + 4.6 * len(c) for c in cells]
        table = Table([made], colWidths=widths, hAlign="LEFT")
        table.setStyle(
            [
                ("VALIGN", (0, 0), (-1, -1), "MIDDLE"),
                ("LEFTPADDING", (0, 0), (-1, -1), 2),
                ("RIGHTPADDING", (0, 0), (-1, -1), 2),
            ]
        )
        return table

    def _heading(self, node: Node, name: str) -> Iterator[Any]:
        yield self.paragraph(self.markup(node), "h3")

    def _list(self, node: Node, name: str) -> Iterator[Any]:
        for number, item in enumerate(node.all("li"), start=1):
            bullet = f"{number}." if node.tag == "ol" else "•"
            yield self.paragraph(self.markup(item), "list", bulletText=bullet)

    def _details(self, node: Node, name: str) -> Iterator[Any]:
        if "open" not in node.attributes and not any(True for _ in node.all("img")):
            return
        for child in node.children:
            if isinstance(child, Node) and child.tag == "summary":
                yield self.paragraph(self.markup(child), "h3")
            elif isinstance(child, Node):
                yield from self.block(child, name)

    def _code(self, node: Node, name: str) -> Iterator[Any]:
        from reportlab.platypus import XPreformatted

        text = "".join(c for c in node.children if isinstance(c, str))
        lines = [line[k : k + 130] for line in text.splitlines() for k in range(0, max(len(line), 1), 130)]
        for start in range(0, len(lines), 60):  # a piece that fits a page
            yield XPreformatted(escape("\n".join(lines[start : start + 60])), self.styles["code"])

    def _tiles(self, node: Node, name: str) -> Iterator[Any]:
        from reportlab.platypus import Table

        tiles, tones = [], []
        for tile in (n for n in node.children if isinstance(n, Node)):
            term = next(tile.all("dt")).text()
            value = next(tile.all("b")).text()
            remark = next((n.text() for n in tile.all("span")), "")
            tiles.append(
                [
                    self.paragraph(escape(term), "note"),
                    self.paragraph(f"<b>{escape(value)}</b>", "p"),
                    self.paragraph(escape(remark), "note"),
                ]
            )
            tones.append(next((_TONES[t] for t in _TONES if t in tile.classes), "#b9c2cb"))
        if not tiles:
            return
        table = Table([tiles], colWidths=[self.width / len(tiles)] * len(tiles))
        table.setStyle(
            [("BACKGROUND", (0, 0), (-1, -1), _SOFT), ("VALIGN", (0, 0), (-1, -1), "TOP")]
            + [("LINEABOVE", (k, 0), (k, 0), 2, tone) for k, tone in enumerate(tones)]
        )
        yield table

    def _image(self, node: Node, width: float, height: float | None = None) -> Any:
        from reportlab.platypus import Image

        head, _, data = node.attributes["src"].partition(",")
        if not head.startswith("data:image/png"):
            raise AssertionError("figures are pixels here")
        image = Image(io.BytesIO(base64.b64decode(data)))
        image.drawWidth, image.drawHeight = width, height or width * image.imageHeight / image.imageWidth
        return image

    def _picture(self, node: Node, name: str) -> Iterator[Any]:
        yield self._image(node, min(self.width, 150.0))

    def _figure(self, node: Node, name: str) -> Iterator[Any]:
        from reportlab.platypus import KeepTogether, Table

        if "modes" in node.classes:
            caption = next(node.all("figcaption"))
            words = [n for n in caption.children if isinstance(n, Node) and "scale" not in n.classes]
            left: list[Any] = [
                self.paragraph(self.markup(n) if n.tag != "b" else f"<b>{escape(n.text())}</b>", "note") for n in words
            ]
            for scale in (n for n in caption.children if isinstance(n, Node) and "scale" in n.classes):
                ends = [n.text() for n in scale.all("i")]
                left.append(self._row([ends[0], self._image(next(scale.all("img")), 56, 6), ends[-1]]))
            triple = next((n for n in node.all("div") if "triple" in n.classes), None)
            right = self._sheet(triple, 3, 360.0) if triple else ""
            table = Table([[left, right]], colWidths=[self.width - 366, 366])
            table.setStyle([("VALIGN", (0, 0), (-1, -1), "MIDDLE"), ("LEFTPADDING", (0, 0), (-1, -1), 0)])
            yield KeepTogether([table])
            return
        for image in node.all("img"):
            yield self._image(image, self.width if "plot" in node.classes else 150.0)
        yield from (self.paragraph(self.markup(n), "caption") for n in node.all("figcaption"))

    def _sheet(self, node: Node, columns: int, width: float | None = None) -> Any:
        """Set pictures with their captions in rows."""
        from reportlab.platypus import Table

        each = (width or self.width) / columns
        cells: list[Any] = []
        for item in (n for n in node.children if isinstance(n, Node)):
            image = next(item.all("img"))
            words = " ".join(
                n.text()
                for n in item.all("figcaption", "span")
                if n.tag == "figcaption" or not list(item.all("figcaption"))
            )
            cells.append([self._image(image, each - 10), self.paragraph(escape(words), "caption")])
        rows = [cells[k : k + columns] for k in range(0, len(cells), columns)]
        blank: list[Any] = [""] * (-len(cells) % columns)
        rows[-1] += blank
        table = Table(rows, colWidths=[each] * columns)
        table.setStyle(
            [
                ("ALIGN", (0, 0), (-1, -1), "CENTER"),
                ("LEFTPADDING", (0, 0), (-1, -1), 3),
                ("RIGHTPADDING", (0, 0), (-1, -1), 3),
            ]
        )
        return table

    def _table(self, node: Node, name: str) -> Iterator[Any]:
        from reportlab.lib.styles import ParagraphStyle
        from reportlab.pdfbase.pdfmetrics import stringWidth
        from reportlab.platypus import Paragraph, Table

        caption = next(node.all("caption"), None)
        if caption:
            yield self.paragraph(self.markup(caption), "h3")
        lines = list(node.all("tr"))
        head = sum(1 for part in node.all("thead") for _ in part.all("tr"))
        grid, spans = _grid(lines)
        n = max((len(row) for row in grid), default=0)
        if n == 0:
            return
        alone = {(r, c) for r, row in enumerate(grid) for c, cell in enumerate(row) if cell is not None} - {
            (r, c) for r, c, _, across in spans if across > 1
        }
        need = [
            max(
                (
                    stringWidth(cell.text(), self.bold, 1.0)
                    for r, row in enumerate(grid)
                    if c < len(row) and (cell := row[c]) is not None and (r, c) in alone
                ),
                default=1.0,
            )
            for c in range(n)
        ]
        need = [min(x, 34.0) for x in need]  # longer texts are broken
        size = min(7.4, max(4.2, (self.width - 5.0 * n) / max(sum(need), 1e-9)))
        widths = [size * x + 5.0 for x in need]
        if sum(widths) > self.width:
            widths = [w * self.width / sum(widths) for w in widths]

        def set_cell(node: Node | None, row: int) -> Any:
            if node is None:
                return ""
            left = "text" in node.classes or (
                node.tag == "th" and (row >= head or node.attributes.get("scope") == "row")
            )
            centred = node.attributes.get("scope") == "colgroup"
            style = ParagraphStyle(
                "cell", fontName=self.bold if node.tag == "th" else self.regular, fontSize=size, leading=1.25 * size,
                textColor=_MUTED if row < head else _INK, alignment=1 if centred else 0 if left else 2,
            )  # fmt: skip
            return Paragraph(self.markup(node), style)

        rows = [[set_cell(c, r) for c in row] + [""] * (n - len(row)) for r, row in enumerate(grid)]
        table = Table(rows, colWidths=widths, repeatRows=head, hAlign="LEFT", spaceBefore=3, spaceAfter=6)
        table.setStyle(
            [
                ("LINEBELOW", (0, 0), (-1, -1), 0.4, _LINE),
                ("VALIGN", (0, 0), (-1, -1), "MIDDLE"),
                ("LEFTPADDING", (0, 0), (-1, -1), 1.5),
                ("RIGHTPADDING", (0, 0), (-1, -1), 1.5),
                ("TOPPADDING", (0, 0), (-1, -1), 1.5),
                ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
            ]
            + [("SPAN", (c, r), (c + across - 1, r + down - 1)) for r, c, down, across in spans]
        )
        yield table


def _grid(lines: list[Node]) -> tuple[list[list[Node | None]], list[tuple[int, int, int, int]]]:
    """Return the cells of a table by row and column, None where another one reaches, and (row, column, rows, columns) of those."""
    grid: list[list[Node | None]] = [[] for _ in lines]
    taken: set[tuple[int, int]] = set()
    spans = []
    for r, line in enumerate(lines):
        c = 0
        for cell in (n for n in line.children if isinstance(n, Node) and n.tag in ("th", "td")):
            while (r, c) in taken:
                grid[r].append(None)
                c += 1
            down, across = int(cell.attributes.get("rowspan", 1)), int(cell.attributes.get("colspan", 1))
            taken |= {(r + i, c + j) for i in range(down) for j in range(across)}
            grid[r] += [cell, *[None] * (across - 1)]
            if down > 1 or across > 1:
                spans.append((r, c, min(down, len(lines) - r), across))
            c += across
    return grid, spans
