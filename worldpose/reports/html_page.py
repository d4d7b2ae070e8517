"""Self-contained HTML pages from images, tables and embedded pages; they load nothing."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import count
from typing import TypeAlias


@dataclass(frozen=True)
class EmbeddedPage:
    """A whole HTML page in a frame of its own, such as the 3D viewer with clips."""

    title: str
    html: str


@dataclass(frozen=True)
class LinkedFile:
    """A file in the folder of the page, which a reader opens by a link with a title as its text."""

    title: str
    name: str


@dataclass(frozen=True)
class CaptionedImage:
    """A PNG with a caption."""

    caption: str
    png: bytes


@dataclass(frozen=True)
class Table:
    """A table with a heading and rows of text; the prefix ">" of columns marks numeric ones."""

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Section:
    """A section of the page with a link in its navigation bar, a lead, and blocks in order."""

    heading: str
    blocks: tuple[CaptionedImage | Table | EmbeddedPage | LinkedFile, ...]
    lead: str = ""


class Failure(str):
    """Text of a table cell with failure style."""


@dataclass(frozen=True)
class Folded:
    """Collapsible tables at the end of a page, without empty ones; all but the first are folded."""

    heading: str
    tables: tuple[Table, ...]


def whole_page(
    title: str,
    about: str,
    sections: Sequence[Section],
    *,
    tiles: Sequence[tuple[str, str]] = (),
    last: Folded | None = None,
) -> str:
    """Return a whole HTML page, without empty sections, and with key metrics as tiles."""
    shown = [section for section in sections if section.blocks]
    allowed = " ".join(dict.fromkeys(_allowed_scripts(shown)))
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    policy += f"; script-src {allowed}" if allowed else ""
    numbers = count(1)
    images = [
        block.png for part in shown for block in part.blocks if isinstance(block, CaptionedImage)
    ]
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the codec releases the interpreter lock
        small = dict(zip(images, pool.map(compress_image, images), strict=True))
    parts = "\n".join(_section(section, next(numbers), small) for section in shown)
    links = "".join(
        f'<a href="#part{number}">{escape(section.heading)}</a>'
        for number, section in enumerate(shown, 1)
    )
    end = ""
    if last is not None:
        links += f'<a href="#last">{escape(last.heading)}</a>'
        end = (
            f'\n<section id="last"><h2>{escape(last.heading)}</h2>\n{_folded_html(last)}</section>'
        )
    style = (files("worldpose.reports") / "page" / "report.css").read_text(encoding="utf-8")
    marks = "".join(
        f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in tiles
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f"<header><div><h1>{escape(title)}</h1><p>{escape(about)}</p>"
        f'<div class="tiles">{marks}</div></div></header>\n'
        f'<nav aria-label="Parts of this page"><div>{links}</div></nav>\n'
        f"<main>\n{parts}{end}\n</main>\n</body>\n</html>\n"
    )


def _allowed_scripts(sections: Sequence[Section]) -> Iterator[str]:
    """Yield a source of the policy, which embedded pages inherit, for each of their scripts."""
    for section in sections:
        for block in section.blocks:
            if isinstance(block, EmbeddedPage):
                for script in re.findall(r'<script type="module">(.*?)</script>', block.html, re.S):
                    digest = base64.b64encode(hashlib.sha256(script.encode()).digest())
                    yield f"'sha256-{digest.decode('ascii')}'"


def _section(section: Section, number: int, small: Mapping[bytes, SmallImage]) -> str:
    lead = f'<p class="lead">{escape(section.lead)}</p>\n' if section.lead else ""
    blocks = "\n".join(_block(block, small) for block in section.blocks)
    return (
        f'<section id="part{number}"><h2>{escape(section.heading)}</h2>\n{lead}{blocks}</section>'
    )


def _block(
    block: CaptionedImage | Table | EmbeddedPage | LinkedFile, small: Mapping[bytes, SmallImage]
) -> str:
    if isinstance(block, EmbeddedPage):
        html = block.html.replace("&", "&amp;").replace('"', "&quot;")
        return f'<iframe title="{escape(block.title)}" srcdoc="{html}"></iframe>'
    if isinstance(block, LinkedFile):
        return f'<p><a href="{_relative_address(block.name)}">{escape(block.title)}</a></p>'
    if isinstance(block, CaptionedImage):
        return _figure(block.caption, small[block.png])
    heading = f"<h3>{escape(block.heading)}</h3>\n" if block.heading else ""
    return heading + _table(block.columns, block.rows)


def _relative_address(name: str) -> str:
    """Return a file's name as an address, percent-encoded; the library does not use urllib."""
    return "".join(
        letter
        if letter.isascii() and (letter.isalnum() or letter in "._-")
        else "".join(f"%{byte:02X}" for byte in letter.encode())
        for letter in name
    )


def _folded_html(last: Folded) -> str:
    return "\n".join(
        f"<details{' open' if table is last.tables[0] else ''}><summary>{escape(table.heading)}"
        f"</summary>{_table(table.columns, table.rows)}</details>"
        for table in last.tables
        if table.rows
    )


def _figure(caption: str, image: SmallImage) -> str:
    kind, content, (width, height) = image
    data = base64.b64encode(content).decode("ascii")
    caption = escape(caption)
    return (
        f'<figure><img alt="{caption}" width="{width}" height="{height}" decoding="async" '
        f'src="data:image/{kind};base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain text; the prefix ">" marks numeric columns."""
    kinds = [' class="number"' if column.startswith(">") else "" for column in columns]
    lines, long = [], ' class="long"'
    if any(columns):
        cells = (
            f"<th{kind}>{escape(column.removeprefix('>'))}</th>"
            for kind, column in zip(kinds, columns, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    for row in rows:
        cells = (
            f'<td class="bad">{escape(cell)}</td>'
            if isinstance(cell, Failure)
            else f"<td{kind or long * (len(cell) > 40)}>{escape(cell)}</td>"
            for kind, cell in zip(kinds, row, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return '<div class="table"><table>\n' + "\n".join(lines) + "\n</table></div>"


SmallImage: TypeAlias = tuple[str, bytes, tuple[int, int]]
"""Kind, content, and size (width, height) [px] of an image."""


def compress_image(png: bytes) -> SmallImage:
    """Return kind, content and size (width, height) [px] of a PNG: as WebP if it is smaller."""
    effort = 2  # of 6 for a small WebP: the usual 4 takes twice as long, for 2 to 4 % less
    quality = 88  # webP quality that keeps lines of one pixel sharp
    size = (int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big"))
    photograph_bytes = 200_000  # a PNG of this size is a photograph, not a plot
    if len(png) < photograph_bytes:
        return "png", png, size
    from PIL import Image  # late: pages without large images do not need it

    webp = io.BytesIO()
    with Image.open(io.BytesIO(png)) as picture:
        picture.save(webp, "webp", quality=quality, method=effort)
    small = webp.getvalue()
    return ("webp", small, size) if len(small) < len(png) else ("png", png, size)
