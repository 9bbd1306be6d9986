"""`summary.html`: one page about all dives of a batch, which opens anywhere without a network.

The range over each dive is shown as a sparkline.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from aqualvs import __version__
from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.report import html
from aqualvs.report.html import Card
from aqualvs.results.files import replace_text, writing
from aqualvs.results.run_request import now
from aqualvs.text import clock, count_text


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

    `steps` are from `range_steps`; `low`, `high`: ranges at the picture's edges, in metres.
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

# What a reader of the data set types first.
_EXAMPLES = {
    "DuckDB": "SELECT dive, avg(range_m) FROM read_parquet('dataset/posture/**/*.parquet', "
    "hive_partitioning = true) GROUP BY dive;",
    "Polars": 'polars.scan_parquet("dataset/posture/**/*.parquet", hive_partitioning=True)',
    "pandas": 'pandas.read_parquet("dataset/posture", filters=[("valid", "==", True)])',
}


def write_summary(folder: Path, records: Sequence[DiveRecord]) -> Path:
    """Write `summary.html` of a batch's folder, the dives in the order of `records`.

    Reports are in `dives/NAME` below the folder. Raises `OutputError` if it cannot be written.
    """
    path = folder / SUMMARY_HTML
    text = _page(folder, records)
    with writing(path):
        replace_text(path, text)
    return path


def _page(folder: Path, records: Sequence[DiveRecord]) -> str:
    ranges = [r.summary[key] for r in records for key in _ENDS if key in r.summary]
    low, high = (min(ranges), max(ranges)) if ranges else (0.0, 0.0)
    lead = "Ranges over time share one scale"
    lead += f", {low:.2f} to {high:.2f} m; a gap is a stretch without a posture." if ranges else "."
    notes = [note for record in records for note in _notes_on(record)]
    max_notes = 12
    if len(notes) > max_notes:
        more = f"and {len(notes) - max_notes} more, in the table and in the dives’ own reports"
        notes = [*notes[:max_notes], more]

    def address(record: DiveRecord, file: str) -> str:
        """Return the address of a file of a dive; empty if it is not there."""
        place = Path("dives") / record.name / file
        return quote(place.as_posix()) if (folder / place).is_file() else ""

    content = {
        "title": folder.resolve().name,
        "subtitle": _rigs(records),
        "cards": html.cards(_cards(records)),
        "warnings": html.notice(notes),
        "lead": lead,
        "footer": f"Written {html.moment(now())} by aqualvs {__version__}.",
        "records": records,
        "with_net": any(record.net for record in records),
        "clock": clock,
        "address": address,
        "range_svg": lambda steps: html.Raw(range_svg(steps, low, high)),
        "examples": _EXAMPLES,
    }
    return html.page("summary.html", content)


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
        Card("Recorded", clock(seconds), count_text(n_frames, "frame", commas=True)),
        Card("Frames with a posture", share, f"{n_valid:,} of {n_frames:,}"),
    ]


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
