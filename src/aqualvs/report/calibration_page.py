"""Report of a calibration: one static HTML page that opens anywhere and prints well.

The commands fill a `CalibrationPage`; the tables and sections here escape all of its
text. Unknown values are shown as a dash. There are no scripts and no requests to a network.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.optics.expected_error import ExpectedError, in_mm_and_degrees
from aqualvs.report import html
from aqualvs.report import svg as draw
from aqualvs.report.calibration_charts import N_VECTORS, picture_view, residual_view
from aqualvs.report.calibration_material import (
    CalibrationPage,
    LaserRow,
    ParameterRow,
    ResidualMap,
    Series,
    ViewRow,
)
from aqualvs.report.html import Raw, swatch, table
from aqualvs.report.svg import line_chart
from aqualvs.results.files import writing
from aqualvs.text import signed

DASH = "–"
LIMIT_PERCENT, LIMIT_DEG = 0.5, 0.5

_HIGH_RMS = 2.5


def number(value: float | None, digits: int, *, plus: bool = False) -> str:
    """Return a number with a true minus sign, or a dash if there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    # Adding zero turns a rounded -0.0 into 0.0.
    rounded = round(value, digits) + 0.0
    return signed(f"{rounded:{'+' if plus and rounded else ''}.{digits}f}")


def view_table(views: Sequence[ViewRow]) -> Raw:
    """Return the views with a bar for the rms of each; in two columns if they are many."""
    used = [view.rms_px for view in views if view.used and math.isfinite(view.rms_px)]
    median = float(np.median(used)) if used else math.nan
    remarks = any(view.remark or not view.used for view in views)
    rows_per_column = 18
    length = -(-len(views) // 2) if len(views) > rows_per_column else len(views)
    parts = [
        _view_part(views[start : start + length], median, remarks)
        for start in range(0, len(views), length)
    ]
    lead = ""
    if math.isfinite(median):
        lead = (
            '<p class="lead">Distance between measured and predicted points, rms. The dashed line '
            f"is the median of the views used, {median:.3f} px; orange views are left out, or more "
            f"than {_HIGH_RMS:g} times as far off.</p>"
        )
    return Raw(f'{lead}<div class="halves">{"".join(parts)}</div>')


def parameter_table(rows: Sequence[ParameterRow]) -> Raw:
    """Return values with their sigmas and, where it is known, what they were before."""
    changed = any(row.before is not None and math.isfinite(row.before) for row in rows)
    head = ["parameter", "value", "± σ", "unit"]
    head += ["before", "change", "change in σ"] if changed else []
    cells = [
        [row.name, number(row.value, row.digits), _sigma_text(row), row.unit or DASH]
        + (_change_cells(row) if changed else [])
        for row in rows
    ]
    return table(head, cells)


def expectation_view(rows: Sequence[ExpectedError]) -> Raw:
    """Return what the calibration lets expect on a target: a sentence and a table."""
    head = ("target at", "σ from", "range, mm", "range, %", "pitch, °", "yaw, °")
    cells = [line for row in rows for line in _expectation_lines(row)]
    return Raw(_expectation_text(rows) + table(head, cells, texts=2))


def laser_tables(rows: Sequence[LaserRow]) -> Raw:
    """Return the laser planes, and how well each is known; two tables, to fit on paper."""
    moved = any(row.moved for row in rows)
    planes = ["laser", "normal x", "normal y", "normal z", "offset, mm", "model"]
    planes += ["moved"] if moved else []
    quality = ["laser", "σ normal, °", "σ offset, mm", "rms, px", "rms, mm", "points", "seen on"]
    plane_cells, quality_cells = [], []
    for index, row in enumerate(rows):
        name = Raw(swatch(index) + escape(row.name))
        normal = [number(float(value), 5, plus=True) for value in np.ravel(row.normal)]
        line = [name, *normal, number(row.offset_mm, 2), row.model or DASH]
        plane_cells.append(line + ([row.moved or DASH] if moved else []))
        quality_cells.append(
            [
                name,
                number(row.sigma_normal_deg, 3),
                number(row.sigma_offset_mm, 3),
                number(row.rms_px, 2),
                number(row.rms_mm, 3),
                f"{row.n_points:,}",
                row.surfaces or DASH,
            ]
        )
    return Raw(
        '<p class="lead">Plane n·X = offset, in the frame of the dome (x right, y forward, z up).'
        f"</p>{table(planes, plane_cells, tail=1 + moved)}{table(quality, quality_cells, tail=1)}"
    )


def _marked(text: str, wrong: bool) -> str:
    return Raw(f'<span class="refused">{escape(text)}</span>') if wrong else text


def _view_part(views: Sequence[ViewRow], median: float, remarks: bool) -> str:
    head = ["view", "", "rms, px", "points", *(["remark"] if remarks else [])]
    cells = []
    for view in views:
        wrong = not view.used or view.rms_px > _HIGH_RMS * median
        words = "; ".join(filter(None, ("" if view.used else "left out", view.remark)))
        rms = _rms_bar(view, median, wrong), _marked(number(view.rms_px, 3), wrong)
        line = [_marked(view.name, wrong), *rms, f"{view.n_points:,}", _marked(words, wrong)]
        cells.append(line[: len(head)])
    return table(head, cells, tail=int(remarks))


def _rms_bar(view: ViewRow, median: float, wrong: bool) -> Raw:
    """Return the rms as a bar; one that would be too long is cut open at its end."""
    if not math.isfinite(view.rms_px):
        return Raw("")
    bar, bar_height, bar_reach = 180.0, 14.0, 4.0
    reach = bar_reach * median if median > 0.0 else max(view.rms_px, 1e-9)
    length = bar * min(view.rms_px / reach, 1.0)
    colour = draw.OUTLIER if wrong else draw.ACCENT
    body = [draw.box(0.0, 2.0, length, bar_height - 4.0, fill=colour, stroke="none")]
    if view.rms_px > reach:
        gap = ' stroke-width="3"'
        body.append(draw.line(bar - 16, bar_height, bar - 10, 0, colour=draw.PAPER, more=gap))
    if median > 0.0:
        x = bar / bar_reach
        dashed = ' stroke-width="1.2" stroke-dasharray="3 2"'
        body.append(draw.line(x, 0.0, x, bar_height, colour="var(--ink)", more=dashed))
    return draw.svg(bar, bar_height, body, alt=f"{view.rms_px:.3f} px", kind="bar")


def _sigma_text(row: ParameterRow) -> str:
    """Return sigma with the value's decimals, or more where these would hide it."""
    if row.sigma is None:
        return "held"
    digits = row.digits
    if math.isfinite(row.sigma) and row.sigma > 0.0:
        digits = min(max(digits, 1 - math.floor(math.log10(row.sigma))), digits + 3)
    return number(row.sigma, digits)


def _change_cells(row: ParameterRow) -> list[str]:
    if row.before is None or not math.isfinite(row.before):
        return [DASH, DASH, DASH]
    change = row.value - row.before
    sigmas = change / row.sigma if row.sigma is not None and row.sigma > 0.0 else math.nan
    moved_sigmas = 3.0
    return [
        number(row.before, row.digits),
        number(change, row.digits, plus=True),
        _marked(number(sigmas, 1, plus=True), abs(sigmas) > moved_sigmas),
    ]


def _parts_of(row: ExpectedError) -> dict[str, tuple[float, float, float]]:
    """Return standard deviations of range (mm), pitch and yaw (degrees) by their cause."""
    return {
        "calibration": in_mm_and_degrees(row.sigma_calibration),
        "noise of one picture": in_mm_and_degrees(row.sigma_noise),
        "both": in_mm_and_degrees(row.sigma),
    }


def _percent(row: ExpectedError, range_mm: float) -> float:
    return 0.1 * range_mm / row.wall_range if row.wall_range > 0.0 else math.nan


def _expectation_lines(row: ExpectedError) -> Iterator[list[str]]:
    for cause, (range_mm, pitch, yaw) in _parts_of(row).items():
        percent = _percent(row, range_mm)
        strong = cause == "both"
        yield [
            f"{number(row.wall_range, 2)} m" if cause == "calibration" else "",
            Raw(f"<b>{cause}</b>") if strong else cause,
            number(range_mm, 2),
            _marked(number(percent, 3), percent > LIMIT_PERCENT),
            _marked(number(pitch, 3), pitch > LIMIT_DEG),
            _marked(number(yaw, 3), yaw > LIMIT_DEG),
        ]


def _excess(row: ExpectedError) -> float:
    """Return the worst of range, pitch and yaw, relative to what it should stay within."""
    range_mm, pitch, yaw = _expected(row)
    parts = (_percent(row, range_mm) / LIMIT_PERCENT, pitch / LIMIT_DEG, yaw / LIMIT_DEG)
    return math.nan if any(math.isnan(part) for part in parts) else max(parts)


def _expected(row: ExpectedError) -> tuple[float, float, float]:
    """Return both causes together; the calibration's alone where the noise is not known."""
    parts = _parts_of(row)
    both = parts["both"]
    return both if all(map(math.isfinite, both)) else parts["calibration"]


def _expectation_text(rows: Sequence[ExpectedError]) -> str:
    known = [row for row in rows if math.isfinite(_excess(row))]
    if not known:
        return '<p class="verdict bad">The accuracy on a target is not known.</p>'
    worst = max(known, key=_excess)
    range_mm, pitch, yaw = _expected(worst)
    fine = _excess(worst) <= 1.0 and len(known) == len(rows)
    limits = f"{LIMIT_PERCENT:g} % of range and {LIMIT_DEG:g}°"
    where = " at every distance" if len(rows) > 1 else ""
    start = f"Good to {limits}{where}." if fine else f"Not good to {limits}."
    cause, end = "one picture gives", "averaging pictures does not remove it."
    if not all(map(math.isfinite, _parts_of(worst)["both"])):
        cause, end = "the calibration alone gives", "the noise of the picture is additional."
    means = (
        f" On a target at {number(worst.wall_range, 2)} m {cause} the range to "
        f"{number(range_mm, 1)} mm ({number(_percent(worst, range_mm), 2)} %), pitch to "
        f"{number(pitch, 2)}° and yaw to {number(yaw, 2)}° (one standard deviation). The "
        f"calibration’s part is the same in every picture: {end}"
    )
    kind = "good" if fine else "bad"
    return f'<p class="verdict {kind}"><b>{start}</b>{means}</p>'


def write_page(page: CalibrationPage, path: Path) -> Path:
    """Write the report of a calibration to a file, and return its path.

    The page carries all it needs and asks no network. Raises `OutputError` if it cannot be written.
    """
    # Names of files that are no Unicode reach Python as surrogates, which UTF-8 refuses.
    data = page_html(page).encode("utf-8", errors="replace")
    with writing(path):
        path.write_bytes(data)
    return path


def page_html(page: CalibrationPage) -> str:
    """Return the report of a calibration as HTML."""
    names = [view.name for view in page.views]
    sections: list[tuple[str, str, Callable[[Any], str], Any]] = [
        ("expectations", "Accuracy on a target", expectation_view, page.expectations),
        ("parameters", "Parameters", parameter_table, page.parameters),
        ("lasers", "Lasers", laser_tables, page.lasers),
        ("series", "Charts", _charts, page.series),
        ("residuals", "Residuals", lambda maps: _residuals(maps, names), page.residual_maps),
        ("views", "Views", view_table, page.views),
        ("pictures", "Pictures", picture_view, page.pictures),
        ("facts", "Command, files and versions", html.fact_table, page.facts),
    ]
    content = {
        "title": page.title,
        "subtitle": page.subtitle,
        "cards": html.cards(page.cards),
        "warnings": html.notice(page.warnings),
        "words": page.words,
        "parts": [
            (name, heading, Raw(view(part))) for name, heading, view, part in sections if part
        ],
    }
    return html.page("calibration.html", content)


def _charts(found: Sequence[Series]) -> str:
    return "\n".join(
        f'<div class="whole"><h3>{escape(series.title)}</h3>{line_chart(series)}</div>'
        for series in found
    )


def _residuals(maps: Sequence[ResidualMap], names: Sequence[str]) -> str:
    # Vectors of all maps together; with them and the pictures' share a page stays below 1 MB.
    all_vectors = 7500
    share = min(N_VECTORS, all_vectors // len(maps))
    return "\n".join(
        f'<div class="whole"><h3>{escape(found.title)}</h3>'
        f"{residual_view(found, names, n_vectors=share)}</div>"
        for found in maps
    )
