"""HTML pages with text, figures and tables in one file, without network access and scripts."""

import base64
import html
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from matplotlib.figure import Figure

from jaxsonar.fileio.atomic_files import atomic_write
from jaxsonar.reports.plot_style import render_figure
from jaxsonar.reports.text import NO_VALUE

PAGE_BYTES = 8_000_000
"""Maximum size of a page. A figure that exceeds its part of it as SVG is embedded as PNG."""


@dataclass(frozen=True)
class Picture:
    """A figure on the page."""

    figure: Figure
    alt: str
    """Alternative text for readers who cannot see the figure."""
    caption: str = ""


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str
    """Key of the values in the rows."""
    title: str
    unit: str = ""
    """Unit of the values, shown in the header."""
    digits: int | None = None
    """Number of decimals; by default four significant digits. Integers are shown unchanged."""


@dataclass(frozen=True)
class Table:
    """A table. Numbers are right-aligned, text is left-aligned; the first column names the rows."""

    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    """Values by column key. A missing value, None and NaN are shown as a dash."""
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A section of the page with a title."""

    title: str
    parts: Sequence[str | Picture | Table]
    """Parts in order. A string is text; an empty line in it starts a new paragraph."""


def save_report(filename: str | os.PathLike[str], *, title: str, intro: str, sections: Sequence[Section]) -> None:
    """Write a page, atomically. The same content gives the same bytes.

    Args:
        filename: the HTML file.
        title: title of the page.
        intro: text below the title, as in a section.
        sections: the sections; if there are several, links to them come first.

    Raises:
        SonarError: the file cannot be written.
    """
    with atomic_write(filename) as file:
        file.writelines(f"{line}\n" for line in _page(title, intro, sections))


def _page(title: str, intro: str, sections: Sequence[Section]) -> Iterator[str]:
    pictures = sum(isinstance(part, Picture) for section in sections for part in section.parts)
    limit = PAGE_BYTES * 3 // 4 // max(pictures, 1)  # base64 turns 3 bytes into 4 characters
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    yield f"<title>{_text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<header>\n<h1>{_text(title)}</h1>"
    yield from _paragraphs(intro)
    yield "</header>"
    if len(sections) > 1:
        yield '<nav aria-label="Contents">\n<ul>'
        for number, section in enumerate(sections, start=1):
            yield f'<li><a href="#section-{number}">{_text(section.title)}</a></li>'
        yield "</ul>\n</nav>"
    yield "<main>"
    for number, section in enumerate(sections, start=1):
        yield f'<section aria-labelledby="section-{number}">'
        yield f'<h2 id="section-{number}">{_text(section.title)}</h2>'
        for part in section.parts:
            if isinstance(part, Picture):
                yield from _picture(part, limit)
            elif isinstance(part, Table):
                yield from _table(part)
            else:
                yield from _paragraphs(part)
        yield "</section>"
    yield "</main>\n</body>\n</html>"


def _paragraphs(text: str) -> Iterator[str]:
    for paragraph in text.strip().split("\n\n"):
        if paragraph.strip():
            yield f"<p>{_text(paragraph.strip())}</p>"


def _picture(picture: Picture, limit: int) -> Iterator[str]:
    # Embedded as an image, so that ids in one SVG cannot collide with those of another.
    kind, data = "svg+xml", render_figure(picture.figure, "svg")
    if len(data) > limit:
        kind, data = "png", render_figure(picture.figure, "png")
    width, height = (round(96 * inches) for inches in picture.figure.get_size_inches())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    yield f'<figure>\n<img src="{source}" alt="{_text(picture.alt)}" width="{width}" height="{height}">'
    if picture.caption:
        yield f"<figcaption>{_text(picture.caption)}</figcaption>"
    yield "</figure>"


def _table(table: Table) -> Iterator[str]:
    values = [[row.get(column.key) for column in table.columns] for row in table.rows]
    alignments = ["" if _is_text(column) else ' class="number"' for column in zip(*values, strict=True)]
    alignments = alignments or [""] * len(table.columns)  # no rows
    # tabindex: wide tables can be scrolled by keyboard.
    yield f'<div class="table" role="region" tabindex="0" aria-label="{_text(table.caption or "Table")}">\n<table>'
    if table.caption:
        yield f"<caption>{_text(table.caption)}</caption>"
    yield "<thead>\n<tr>"
    for column, alignment in zip(table.columns, alignments, strict=True):
        unit = f' <span class="unit">({_text(column.unit)})</span>' if column.unit else ""
        yield f'<th scope="col"{alignment}>{_text(column.title)}{unit}</th>'
    yield "</tr>\n</thead>\n<tbody>"
    for row in values:
        cells = [_cell(value, column.digits) for value, column in zip(row, table.columns, strict=True)]
        first = f'<th scope="row"{alignments[0]}>{cells[0]}</th>'
        yield (
            "<tr>"
            + first
            + "".join(f"<td{s}>{c}</td>" for c, s in zip(cells[1:], alignments[1:], strict=True))
            + "</tr>"
        )
    yield "</tbody>\n</table>\n</div>"


def _is_text(values: Sequence[Any]) -> bool:
    return any(isinstance(value, str) for value in values)


def _cell(value: Any, digits: int | None) -> str:
    if value is None or (isinstance(value, Real) and math.isnan(value)):
        return NO_VALUE
    if not isinstance(value, Real):
        return _text(str(value))
    whole = isinstance(value, Integral)
    shown = str(value) if whole else f"{float(value):.4g}" if digits is None else f"{float(value):.{digits}f}"
    return shown.replace("-", "−")


def _text(text: str) -> str:
    """Escape text for HTML content and quoted attributes. Unprintable characters become escape sequences."""
    return html.escape("".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text))


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 60rem; padding: 1.5rem 1rem 4rem; background: #fff; color: #1a1a1a;
  font: 1rem/1.55 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 0.75rem; }
h2 { font-size: 1.25rem; line-height: 1.3; margin: 2.5rem 0 0.75rem; padding-top: 1rem; border-top: 1px solid #d0d0d0; }
p { max-width: 42rem; margin: 0 0 1rem; }
nav ul { margin: 1rem 0; padding: 0; list-style: none; display: flex; flex-wrap: wrap; gap: 0.25rem 1.25rem; }
a { color: #005a94; }
figure { margin: 1.5rem 0; }
img { display: block; max-width: 100%; height: auto; }
figcaption, caption { max-width: 42rem; color: #4a4a4a; font-size: 0.875rem; line-height: 1.45; text-align: left; }
figcaption { margin-top: 0.5rem; }
caption { padding-bottom: 0.5rem; }
.table { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; font-size: 0.875rem; line-height: 1.4; font-variant-numeric: tabular-nums; }
th, td { padding: 0.35rem 0.5rem; text-align: left; vertical-align: baseline; border-bottom: 1px solid #e2e2e2; }
thead th { vertical-align: bottom; border-bottom: 2px solid #8c8c8c; }
tbody th { font-weight: normal; min-width: 8rem; }
.number { text-align: right; white-space: nowrap; }
thead .number { white-space: normal; }
.unit { color: #4a4a4a; font-weight: normal; white-space: nowrap; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav { display: none; }
  h2 { break-after: avoid; }
  figure, tr { break-inside: avoid; }
  .table { overflow: visible; }
  table { font-size: 7pt; }
  th, td { padding: 0.2rem 0.25rem; }
  tbody th { min-width: 0; }
  img { max-height: 22cm; width: auto; }
}
"""
