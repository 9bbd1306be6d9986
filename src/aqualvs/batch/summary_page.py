"""`summary.html`: one page about all dives of a batch, which opens anywhere without a network.

The range over each dive is shown as a sparkline.
"""

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from aqualvs import __version__
from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.errors import OutputError
from aqualvs.report import html
from aqualvs.report.html import Card
from aqualvs.results.files import replace_text
from aqualvs.results.folder import NET_MAP_PNG, REPORT_HTML
from aqualvs.results.run_request import now
from aqualvs.text import clock


def range_steps(ranges: ArrayLike) -> list[float | None]:
    """Return the median range in at most 120 equal parts of a dive, in metres; None without any.

    `ranges`, shape (N,): metres, NaN without a posture.
    """
    steps = 120
    parts = np.array_split(np.asarray(ranges, np.float64), steps)
    known = [part[np.isfinite(part)] for part in parts if len(part)]
    return [round(float(np.median(part)), 4) if len(part) else None for part in known]


def range_svg(steps: Sequence[float | None], low: float, high: float) -> str:
    """Return the steps as a line in SVG; without a posture there is no line.

    Parameters
    ----------
    steps : sequence of float or None
        From `range_steps`.
    low, high : float
        Ranges at the picture's lower and upper edge, in metres.
    """
    if not steps or not high > low:
        return ""
    width, height = 180, 34
    edge = 2.0
    across = (width - 2 * edge) / len(steps)
    path, pen_is_down = "", False
    for i, step in enumerate(steps):
        if step is None:
            pen_is_down = False
            continue
        share = min(max((step - low) / (high - low), 0.0), 1.0)
        x, y = edge + across * i, height - edge - share * (height - 2 * edge)
        path += f"{'L' if pen_is_down else 'M'}{x:.1f} {y:.1f}H{x + across:.1f}"
        pen_is_down = True
    return (
        f'<svg class="range" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'role="img" aria-label="range over the dive"><path d="{path}"/></svg>'
    )


SUMMARY_HTML = "summary.html"

_HEAD = ("dive", "state", "duration", "frames", "posture", "range, m", "from – to, m", "over time")
_NET = "net"
# What a reader of the data set types first.
_EXAMPLES = {
    "DuckDB": "SELECT dive, avg(range_m) FROM read_parquet('dataset/posture/**/*.parquet', "
    "hive_partitioning = true) GROUP BY dive;",
    "Polars": 'polars.scan_parquet("dataset/posture/**/*.parquet", hive_partitioning=True)',
    "pandas": 'pandas.read_parquet("dataset/posture", filters=[("valid", "==", True)])',
}


def write_summary(folder: Path, records: Sequence[DiveRecord]) -> Path:
    """Write `summary.html`.

    Parameters
    ----------
    folder : Path
        Of the batch; reports are in `dives/NAME` below it.
    records : sequence of DiveRecord
        In the order of the page.

    Raises
    ------
    OutputError
        If the page cannot be written.
    """
    path = folder / SUMMARY_HTML
    text = _page(folder, records)
    try:
        replace_text(path, text)
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot be written ({fault.strerror}); free the disk or choose another folder"
        ) from fault
    return path


def _page(folder: Path, records: Sequence[DiveRecord]) -> str:
    ranges = [r.summary[key] for r in records for key in _ENDS if key in r.summary]
    low, high = (min(ranges), max(ranges)) if ranges else (0.0, 0.0)
    lead = "Ranges over time share one scale"
    lead += f", {low:.2f} to {high:.2f} m; a gap is a stretch without a posture." if ranges else "."
    texts = {
        "title": folder.resolve().name,
        "subtitle": _rigs(records),
        "lead": lead,
        "footer": f"Written {html.moment(now())} by aqualvs {__version__}.",
    }
    parts = {
        "cards": html.cards(_cards(records)),
        "warnings": html.notice(list(_notes(records))),
        "table": _table(folder, records, low, high),
        "dataset": "".join(
            f"<h3>{name}</h3><pre>{escape(code)}</pre>" for name, code in _EXAMPLES.items()
        ),
    }
    return html.page("summary.html", texts, parts)


_ENDS = ("range_min_m", "range_max_m")


def _rigs(records: Sequence[DiveRecord]) -> str:
    names = sorted({str(r.facts["rig"]) for r in records if r.facts.get("rig")})
    if not names:
        return ""
    return f"Rig{'s' if len(names) > 1 else ''} " + ", ".join(f"“{name}”" for name in names[:8])


def _cards(records: Sequence[DiveRecord]) -> list[Card]:
    measured = [record for record in records if record.facts]
    n_frames = sum(record.facts["n_frames"] for record in measured)
    n_valid = sum(record.facts["n_valid"] for record in measured)
    seconds = sum(record.facts["duration_s"] for record in measured)
    counts = {state: sum(r.state is state for r in records) for state in DiveState}
    others = [f"{n} {state.value}" for state, n in counts.items() if n]
    share = f"{100 * n_valid / n_frames:.1f} %" if n_frames else "–"
    return [
        Card("Dives", str(len(records)), ", ".join(others)),
        Card("Recorded", clock(seconds), f"{n_frames:,} frames"),
        Card("Frames with a posture", share, f"{n_valid:,} of {n_frames:,}"),
    ]


def _notes(records: Sequence[DiveRecord]) -> Iterator[str]:
    """Yield the points that deserve attention, dive by dive, up to a readable number."""
    notes = [note for record in records for note in _notes_on(record)]
    max_notes = 12
    yield from notes[:max_notes]
    if len(notes) > max_notes:
        yield f"and {len(notes) - max_notes} more, in the table and in the dives’ own reports"


def _notes_on(record: DiveRecord) -> Iterator[str]:
    if record.state is not DiveState.FINISHED:
        yield f"{record.name}: {record.state.value}, see the table"
    for key in ("laser_agreement", "net_check"):
        words = (record.summary.get(key) or {}).get("words")
        if words:
            yield f"{record.name}: {words}"
    yield from (f"{record.name}: {words}" for words in record.warnings)
    if record.net.get("n_holes"):
        n, largest = record.net["n_holes"], record.net["largest_hole_mm"]
        found = "1 hole" if n == 1 else f"{n} holes, the largest"
        yield f"{record.name}: the net has {found} of {largest:.0f} mm"


def _table(folder: Path, records: Sequence[DiveRecord], low: float, high: float) -> str:
    kinds = ["", "", *[' class="n"'] * 2, "", *[' class="n"'] * 2, ""]
    titles = list(_HEAD)
    with_net = any(record.net for record in records)
    if with_net:
        kinds, titles = [*kinds, ""], [*titles, _NET]
    head = "".join(f"<th{kind}>{cell}</th>" for kind, cell in zip(kinds, titles, strict=True))
    rows = []
    for record in records:
        found = _cells(folder, record, low, high)
        cells = zip(kinds, [*found, _net(folder, record)] if with_net else found, strict=True)
        bad = ' class="bad"' if record.state is not DiveState.FINISHED else ""
        rows.append(f"<tr{bad}>{''.join(f'<td{kind}>{cell}</td>' for kind, cell in cells)}</tr>")
    body = "\n".join(rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n{body}</table></div>'


def _cells(folder: Path, record: DiveRecord, low: float, high: float) -> list[str]:
    """Return the cells of a dive's row as HTML."""
    why = f'<div class="why">{escape(record.words)}</div>' if record.words else ""
    head = [_link(folder, record), f"{record.state.value}{why}"]
    if not record.facts:
        return [*head, *[""] * (len(_HEAD) - len(head))]
    summary, share = record.summary, record.summary.get("valid_share", 0.0)
    low_share = 0.8
    low_class = ' class="low"' if share < low_share else ""
    ends = [summary.get(key) for key in _ENDS]
    return [
        *head,
        clock(record.facts["duration_s"]),
        f"{record.facts['n_frames']:,}",
        f'<span class="share"><span class="bar"><i{low_class} style="width:{100 * share:.0f}%">'
        f"</i></span>{100 * share:.1f} %</span>",
        f"{summary['range_median_m']:.3f}" if "range_median_m" in summary else "",
        "" if None in ends else f"{ends[0]:.3f} – {ends[1]:.3f}",
        range_svg(record.facts["range_steps"], low, high),
    ]


def _link(folder: Path, record: DiveRecord) -> str:
    return _linked(folder, record, REPORT_HTML, record.name, record.source)


def _net(folder: Path, record: DiveRecord) -> str:
    """Return the condition of a dive's net, with a link to its map."""
    if not record.net:
        return ""
    return _linked(folder, record, NET_MAP_PNG, record.net_text(), "map of the net")


def _linked(folder: Path, record: DiveRecord, file: str, words: str, title: str) -> str:
    """Return words that lead to a file of a dive, if it is there."""
    words, title = escape(words), escape(title, quote=True)
    place = Path("dives") / record.name / file
    if not (folder / place).is_file():
        return f'<span title="{title}">{words}</span>'
    return f'<a href="{quote(place.as_posix())}" title="{title}">{words}</a>'
