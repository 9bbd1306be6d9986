"""The page of `aqualvs reproduce`: the paper's figures beside ours, in one file that prints well.

There are no scripts, and nothing is asked of a network; figures are embedded, and link to the files
beside the page.
"""

import base64
import os
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path

from aqualvs import __version__
from aqualvs.app import report_html as html
from aqualvs.app.disk import writing
from aqualvs.app.report_findings import Card
from aqualvs.app.reproduce.experiment import Finding
from aqualvs.app.reproduce.records import DOI, FIGURES, RESULTS, SERIES, Record, Shown

PAGE = "reproduce.html"
FRAME = "a frame"
"""Among the times: what the scanner takes for one frame (median); no experiment has this name."""

_PAPERS_FPS = 25

_DASH = "–"
# A drawing with more marks than this weighs more than its picture, and opens slower.
_LARGEST_SVG = 250_000
_PX_PER_INCH = 125
_HEAD = ("quantity", "paper", "ours", "bar", "met")


def write_page(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> Path:
    """Write the page from records, and from the figures that are in the folder.

    Parameters
    ----------
    records : sequence of Record
        In the order in which they shall stand.
    seconds : mapping
        How long experiments took, as far as it is known.
    folder : Path

    Returns
    -------
    path : Path
        The page; `reproduce.html` in the folder.

    Raises
    ------
    OutputError
        If a figure cannot be read or the page cannot be written.
    """
    path = folder / PAGE
    with writing(path):
        text = page_html(records, seconds, folder)
        path.write_text(text, encoding="utf-8", errors="replace")
    return path


def page_html(records: Sequence[Record], seconds: Mapping[str, float], folder: Path) -> str:
    """Return the page as HTML; see `write_page`.

    Raises
    ------
    OSError
        If a figure cannot be read.
    """
    return html.page(
        {
            "version": html.text(__version__),
            "doi": DOI,
            "cards": html.cards(_cards(records, seconds)),
            "notice": _notice(records),
            "bars": _bars(records),
            "contents": _contents(records),
            "sections": "\n".join(
                _section(record, seconds.get(record.name), folder) for record in records
            ),
            "results": RESULTS,
            "css": html.asset("report.css") + html.asset("reproduce.css"),
        },
        "reproduce.html",
    )


def _cards(records: Sequence[Record], seconds: Mapping[str, float]) -> Iterator[Card]:
    bars = [finding.met for _, finding in _with_bar(records)]
    done = sum(not record.failure for record in records)
    took = sum(seconds.get(record.name, 0.0) for record in records)
    yield Card("bars met", f"{sum(map(bool, bars))} of {len(bars)}", "what we hold ourselves to")
    yield Card("experiments", f"{done} of {len(records)}", "done; each can be run alone")
    yield Card("time", duration(took), f"on {os.cpu_count() or 1} cores")
    if FRAME in seconds:
        rate = 1.0 / seconds[FRAME]
        yield Card("speed", f"{rate:.0f} fps", f"scanning, median frame; the paper: {_PAPERS_FPS}")


def _notice(records: Sequence[Record]) -> str:
    said = [f"{record.name} failed: {record.failure}" for record in records if record.failure]
    said += [
        f"{record.name}: {finding.what}: {finding.ours}, bar {_said(finding.bar)}"
        for record, finding in _with_bar(records)
        if not finding.met
    ]
    return html.notice(said) if said else ""


def _with_bar(records: Sequence[Record]) -> list[tuple[Record, Finding]]:
    return [
        (record, finding)
        for record in records
        for finding in record.findings
        if finding.met is not None
    ]


def _bars(records: Sequence[Record]) -> str:
    rows = [(html.Raw(_link(record)), *_cells(finding)) for record, finding in _with_bar(records)]
    if not rows:
        return '<p class="note">None of these experiments has a bar to meet.</p>'
    return html.table(("experiment", *_HEAD), rows, tail=len(_HEAD))


def _contents(records: Sequence[Record]) -> str:
    rows = [
        (
            html.Raw(_link(record)),
            record.paper or "ours",
            record.sentence or f"failed: {record.failure}",
        )
        for record in records
    ]
    return html.table(("experiment", "paper", "result"), rows, texts=3)


def _link(record: Record) -> str:
    return f'<a href="#{escape(record.name)}">{escape(record.title)}</a>'


def _section(record: Record, seconds: float | None, folder: Path) -> str:
    parts = [f'<p class="sub">{" · ".join(_origin(record, seconds))}</p>']
    if record.about:
        parts.append(f'<p class="lead">{escape(record.about)}</p>')
    if record.failure:
        parts.append(
            f'<div class="notice warn"><p><b>Failed.</b> {escape(record.failure)}</p></div>'
        )
    if record.sentence:
        parts.append(f'<p class="sentence">{escape(record.sentence)}</p>')
    parts += [_figure(picture, folder) for picture in record.pictures]
    if record.findings:
        rows = map(_cells, record.findings)
        parts.append(html.table(_HEAD, rows, tail=len(_HEAD) - 1))
    if record.notes:
        notes = "".join(f"<li>{escape(note)}</li>" for note in record.notes)
        parts.append(f'<ul class="notes">{notes}</ul>')
    if record.series:
        files = ", ".join(_file_link(f"{SERIES}/{name}", name) for name in record.series)
        parts.append(f'<p class="note files">Numbers: {files}</p>')
    body = "\n".join(parts)
    return (
        f'<section id="{escape(record.name)}">\n<h2>{escape(record.title)}</h2>\n{body}\n</section>'
    )


def _origin(record: Record, seconds: float | None) -> Iterator[str]:
    yield f"Paper: {escape(record.paper)}" if record.paper else "An ablation of ours"
    if seconds is not None:
        yield duration(seconds)
    yield f"<code>aqualvs reproduce {escape(record.name)}</code>"


def _cells(finding: Finding) -> tuple[str, ...]:
    return (
        finding.what,
        finding.paper or _DASH,
        html.Raw(f"<b>{escape(finding.ours)}</b>"),
        _said(finding.bar) or _DASH,
        _mark(finding.met),
    )


def _said(bar: str) -> str:
    # The number stays on the line of its sign.
    return bar.replace("<= ", "≤\u00a0").replace(">= ", "≥\u00a0")


def _mark(met: bool | None) -> str:
    if met is None:
        return _DASH
    words, kind = ("✓ yes", "met") if met else ("✗ no", "missed")
    return html.Raw(f'<span class="{kind}">{words}</span>')


def _figure(picture: Shown, folder: Path) -> str:
    stem = folder / FIGURES / picture.file
    drawing = stem.with_name(f"{stem.name}.svg")
    if drawing.stat().st_size <= _LARGEST_SVG:
        kind, data = "svg+xml", drawing.read_bytes()
    else:
        kind, data = "png", stem.with_name(f"{stem.name}.png").read_bytes()
    files = " ".join(
        _file_link(f"{FIGURES}/{picture.file}.{suffix}", suffix.upper())
        for suffix in ("pdf", "png", "svg")
    )
    caption = escape(picture.caption)
    width = f'style="max-width: {_PX_PER_INCH * picture.width_in:.0f}px"'
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f'<figure><img {width} src="{source}" alt="{caption}"><figcaption>{caption} '
        f'<span class="files">{files}</span></figcaption></figure>'
    )


def _file_link(path: str, words: str) -> str:
    return f'<a href="{escape(path)}">{escape(words)}</a>'


def duration(seconds: float) -> str:
    """Return a time as one would say it."""
    if seconds < 10.0:
        return f"{seconds:.1f} s"
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
