"""HTML kit of all reports: templates, tables, cards, notices.

Every page is a template that extends `base.html`. All text from files is escaped here.
"""

import gzip
import json
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

from aqualvs.text import laser_colour

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _templates() -> "Environment":
    # Not every command writes a page.
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    templates = Environment(
        loader=FunctionLoader(asset), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    known = {"packed": packed, "contents_of": contents_of, "laser_legend": laser_legend}
    templates.globals |= {"asset": lambda name: Raw(asset(name)), **known}
    return templates


def asset(name: str) -> str:
    """Return the text of a file that comes with the package."""
    return files("aqualvs.report").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def packed(name: str) -> str:
    """Return a file that comes with the package as base64 of gzip, for a page to unpack."""
    return b64encode(gzip.compress(asset(name).encode(), mtime=0)).decode("ascii")


_SECTION = re.compile(r'<section\b[^>]*\bid="([^"]+)"[^>]*>\s*<h2>(.*?)</h2>', re.DOTALL)


def contents_of(body: str) -> "Raw":
    """Return links to the sections of a page; nothing where there are few, or it has its own."""
    found = _SECTION.findall(body)
    fewest = 3
    if len(found) < fewest or any(name == "contents" for name, _ in found):
        return Raw("")
    items = "".join(f'<li><a href="#{name}">{title}</a></li>' for name, title in found)
    return Raw(f'<nav aria-label="Contents"><ul class="contents">{items}</ul></nav>')


def page(template: str, content: Mapping[str, object]) -> str:
    """Fill a template of `assets` with content by name; texts are escaped unless they are `Raw`."""
    return _templates().get_template(template).render(content)


class Raw(str):
    """Text that is HTML already."""

    __slots__ = ()

    def __html__(self) -> str:
        return self


@dataclass(frozen=True, slots=True)
class Card:
    """One number of the headline: its name, the number, and a line below it."""

    name: str
    value: str
    note: str


def embedded_json(data: object) -> "Raw":
    """Return JSON that is safe inside a script element.

    Raises `ValueError` if a number is not finite; JSON has no word for it.
    """
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return Raw(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def data_url(data: bytes, kind: str) -> str:
    """Return a picture as an address; `kind` is "png", "jpeg" or "svg+xml"."""
    return f"data:image/{kind};base64,{b64encode(data).decode('ascii')}"


def moment(value: object) -> str:
    """Return a time stamp such as `2026-05-04T09:30:00+00:00` for readers."""
    return str(value).replace("T", " ").replace("+00:00", " UTC")


def text(value: object) -> str:
    """Return something from a file as HTML text."""
    return escape(str(value))


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, texts: int = 1, tail: int = 0
) -> "Raw":
    """Return a table of numbers (to the right) between text columns.

    The first `texts` and the last `tail` columns are text. Cells are escaped, except those that
    are `Raw`.
    """
    kinds = ["" if i < texts or i >= len(head) - tail else ' class="n"' for i in range(len(head))]
    top = "".join(f"<th{kind}>{escape(cell)}</th>" for kind, cell in zip(kinds, head, strict=True))
    body = ""
    for row in rows:
        cells = [cell if isinstance(cell, Raw) else escape(cell) for cell in row]
        line = (f"<td{kind}>{cell}</td>" for kind, cell in zip(kinds, cells, strict=True))
        body += f"<tr>{''.join(line)}</tr>\n"
    return Raw(f'<div class="scroll"><table><thead><tr>{top}</tr></thead>\n{body}</table></div>')


def folded(content: "Raw", n_rows: int, name: str, *, longest: int) -> "Raw":
    """Return a table, folded away where it has more than the longest number of rows."""
    if n_rows <= longest:
        return content
    return Raw(f"<details><summary>All {n_rows} {name}</summary>{content}</details>")


def fact_table(rows: Iterable[tuple[str, str]]) -> "Raw":
    """Return names and values as a table."""
    body = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>\n" for k, v in rows)
    return Raw(f'<div class="scroll"><table class="facts">{body}</table></div>')


def cards(items: Iterable[Card]) -> "Raw":
    """Return the cards of the headline."""
    shown = (
        f'<div class="card"><div class="name">{escape(card.name)}</div>'
        f'<div class="value">{escape(card.value)}</div>'
        f'<div class="note">{escape(card.note)}</div></div>'
        for card in items
    )
    return Raw("\n".join(shown))


def notice(warnings: Sequence[str]) -> "Raw":
    """Return the box of warnings, or the all-clear."""
    if not warnings:
        return Raw('<div class="notice"><p>No warnings.</p></div>')
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return Raw(f'<div class="notice warn"><p><b>Please note</b></p><ul>{items}</ul></div>')


def swatch(index: int) -> "Raw":
    """Return a patch in the colour of laser `index`."""
    return Raw(f'<span class="swatch" style="background:{laser_colour(index)}"></span>')


def laser_legend(names: list[str]) -> "Raw":
    """Return the lasers' names beside their colours."""
    items = "".join(f"<li>{swatch(i)}{escape(name)}</li>" for i, name in enumerate(names))
    return Raw(f'<ul class="legend">{items}</ul>')
