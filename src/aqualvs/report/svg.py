"""Static charts for screen and paper, as inline SVG without scripts.

Places are in the units of a chart's own view box, which the browser scales to the page. Text is
escaped here.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.report.calibration_material import Series
from aqualvs.report.charts import breaks, thin
from aqualvs.report.html import Raw
from aqualvs.text import signed

# Those of the page, light or dark (`colours.css`); outliers as in pictures.
ACCENT, QUIET, EDGE = "var(--accent)", "var(--quiet)", "var(--quiet)"
GRID, BAND, PAPER = "var(--line)", "var(--band)", "var(--paper)"
OUTLIER = "#D55E00"


class _ChartLayout(NamedTuple):
    """Layout of a chart, in units of its view box."""

    width: float = 900.0
    height: float = 300.0
    left: float = 84.0
    right: float = 16.0
    foot: float = 54.0
    lane: float = 20.0
    # A generous width of a character of the charts' text, relative to its size of 14.
    character: float = 7.6


_CHART = _ChartLayout()

_DASHED = ' stroke-width="1.6" stroke-dasharray="7 5"'


@dataclass(frozen=True, slots=True)
class Axis:
    """A linear axis: values `low` to `high` lie at places `start` to `end`."""

    low: float
    high: float
    start: float
    end: float

    def place(self, values: FloatArray) -> FloatArray:
        """Return where values lie, same shape."""
        scale = (self.end - self.start) / (self.high - self.low)
        return self.start + scale * (values - self.low)

    def at(self, value: float) -> float:
        """Return where one value lies."""
        return float(self.place(np.array([value]))[0])

    def ticks(self, count: int) -> list[tuple[float, str]]:
        """Return about `count` round values on the axis, as (place, text)."""
        step = round_step((self.high - self.low) / count)
        digits = decimals(step)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        # Adding zero turns -0.0 into 0.0.
        return [
            (self.at(i * step), signed(f"{i * step + 0.0:.{digits}f}"))
            for i in range(first, last + 1)
        ]


def round_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not below `least` > 0."""
    power = 10.0 ** math.floor(math.log10(least))
    # Powers of ten carry a rounding error; a step may be short of `least` by that much.
    return next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= least * (1.0 - 1e-9))


def decimals(step: float) -> int:
    """Return how many decimals a round step needs."""
    return max(0, -math.floor(math.log10(step) + 1e-9))


def num(value: float) -> str:
    """Return a place as short text, to a tenth."""
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text


def svg(width: float, height: float, body: Iterable[str], *, alt: str, kind: str) -> Raw:
    """Return a picture of its own with words for those who cannot see it."""
    return Raw(
        f'<svg class="{kind}" viewBox="0 0 {num(width)} {num(height)}" role="img" '
        f'aria-label="{escape(alt)}">{"".join(body)}</svg>'
    )


def words_at(x: float, y: float, words: str, *, anchor: str = "middle", kind: str = "") -> str:
    """Return text; `y` is its base line."""
    style = f' class="{kind}"' if kind else ""
    return f'<text x="{num(x)}" y="{num(y)}" text-anchor="{anchor}"{style}>{escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, *, colour: str = EDGE, more: str = "") -> str:
    """Return a straight line; `more` are further attributes."""
    path = f"M{num(x1)} {num(y1)}L{num(x2)} {num(y2)}"
    return f'<path d="{path}" stroke="{colour}" fill="none"{more}/>'


def box(x: float, y: float, width: float, height: float, *, fill: str, stroke: str) -> str:
    """Return a rectangle."""
    return (
        f'<rect x="{num(x)}" y="{num(y)}" width="{num(width)}" height="{num(height)}" '
        f'fill="{fill}" stroke="{stroke}"/>'
    )


def points_path(places: FloatArray) -> str:
    """Return path data of dots, to be stroked with round ends; places have shape (N, 2)."""
    return "".join(f"M{num(x)} {num(y)}h0" for x, y in places.tolist())


def sampled(count: int, limit: int) -> IntArray:
    """Return `limit` of `count` rows at random, ascending and always the same; all if few."""
    if count <= limit:
        return np.arange(count)
    chosen = np.random.default_rng(20210910).choice(count, max(limit, 0), replace=False)
    return np.sort(chosen)


def line_chart(series: Series) -> Raw:
    """Return a series with its band, its level and its marks.

    The band is one standard deviation, cut where it leaves the chart: the first values of a
    recursive estimate may have one that would flatten all others.
    """
    known = np.isfinite(series.y) & np.isfinite(series.x)
    if not known.any():
        return Raw('<p class="note">No value is known.</p>')
    low, high = float(series.x[known].min()), float(series.x[known].max())
    wider = 0.5 if low == high else 0.0
    x_axis = Axis(low - wider, high + wider, _CHART.left, _CHART.width - _CHART.right)
    marks = [(x, words) for x, words in series.marks if math.isfinite(x)]
    inside = sorted(mark for mark in marks if x_axis.low <= mark[0] <= x_axis.high)
    labels, lanes = _mark_text(inside, x_axis)
    head = 10.0 + _CHART.lane * lanes
    y_axis = _y_axis(series, known, head)
    body = [
        *_scales(x_axis, y_axis, series),
        *_curve(series, known, x_axis, y_axis),
        *_level(series, x_axis, y_axis),
        *_mark_lines(inside, x_axis, y_axis),
        *labels,
    ]
    alt = f"{series.title}: {series.y_label} over {series.x_label}"
    chart = svg(_CHART.width, y_axis.start + _CHART.foot, body, alt=alt, kind="line-chart")
    return Raw(chart + _legend(series, marks))


def _y_axis(series: Series, known: BoolArray, head: float) -> Axis:
    """Return the axis with its low end at the bottom; the plot begins at `head`."""
    values = series.y[known]
    level = _level_of(series)
    if level is not None:
        values = np.append(values, level[1])
    low, high = float(values.min()), float(values.max())
    pad = 0.08 * (high - low)
    if series.sigma is not None:
        spread = series.sigma[known & np.isfinite(series.sigma)]
        pad = max(pad, 1.3 * float(np.median(spread)) if len(spread) else 0.0)
    pad = max(pad, 1e-9 + 1e-6 * max(abs(low), abs(high)))
    return Axis(low - pad, high + pad, head + _CHART.height - _CHART.foot, head)


def _scales(x_axis: Axis, y_axis: Axis, series: Series) -> list[str]:
    """Return grid, numbers and names of both axes."""
    left, right, foot, head = x_axis.start, x_axis.end, y_axis.start, y_axis.end
    parts = []
    for y, words in y_axis.ticks(5):
        parts.append(line(left, y, right, y, colour=GRID))
        parts.append(words_at(left - 8, y + 5, words, anchor="end"))
    for x, words in x_axis.ticks(8):
        parts += [line(x, foot, x, foot + 5), words_at(x, foot + 21, words)]
    middle = 0.5 * (foot + head)
    parts.append(words_at(0.5 * (left + right), foot + 46, series.x_label, kind="axis"))
    parts.append(
        f'<g transform="rotate(-90 16 {num(middle)})">'
        f"{words_at(16, middle, series.y_label, kind='axis')}</g>"
    )
    return [*parts, box(left, head, right - left, foot - head, fill="none", stroke=EDGE)]


def _curve(series: Series, known: BoolArray, x_axis: Axis, y_axis: Axis) -> list[str]:
    """Return band and line, broken where values are missing."""
    drawn_per_series = 800
    rows = thin(np.where(known, series.y, np.nan), drawn_per_series)
    x, y = x_axis.place(series.x[rows]), y_axis.place(series.y[rows])
    pieces = np.split(np.arange(len(rows)), np.array(breaks(rows, ~known), dtype=np.int64) + 1)
    parts = []
    if series.sigma is not None:
        half = np.nan_to_num(series.sigma[rows], nan=0.0, posinf=1e9)
        low = np.clip(y_axis.place(series.y[rows] - half), y_axis.end, y_axis.start)
        high = np.clip(y_axis.place(series.y[rows] + half), y_axis.end, y_axis.start)
        around = "".join(
            polyline(np.append(x[p], x[p][::-1]), np.append(low[p], high[p][::-1])) + "Z"
            for p in pieces
        )
        parts.append(f'<path d="{around}" fill="{BAND}"/>')
    drawn = "".join(polyline(x[p], y[p]) for p in pieces)
    return [
        *parts,
        f'<path d="{drawn}" fill="none" stroke="{ACCENT}" stroke-width="2" '
        'stroke-linejoin="round" stroke-linecap="round"/>',
    ]


def polyline(x: FloatArray, y: FloatArray) -> str:
    """Return path data of a line through places, shape (N,) each; of a dot for one place."""
    places = [f"{num(a)} {num(b)}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    return f"M{places[0]}h0" if len(places) == 1 else "M" + "L".join(places)


def _level_of(series: Series) -> tuple[str, float] | None:
    known = series.level is not None and math.isfinite(series.level[1])
    return series.level if known else None


def _level(series: Series, x_axis: Axis, y_axis: Axis) -> list[str]:
    level = _level_of(series)
    if level is None:
        return []
    y = y_axis.at(level[1])
    return [line(x_axis.start, y, x_axis.end, y, colour=QUIET, more=_DASHED)]


def _mark_lines(marks: Sequence[tuple[float, str]], x_axis: Axis, y_axis: Axis) -> list[str]:
    more = ' stroke-width="1.4" stroke-dasharray="3 3"'
    return [
        line(x, y_axis.end - 4, x, y_axis.start, colour=OUTLIER, more=more)
        for x in (x_axis.at(at) for at, _ in marks)
    ]


def _mark_text(marks: Sequence[tuple[float, str]], x_axis: Axis) -> tuple[list[str], int]:
    """Return the words of the first marks, in lanes in which they do not touch, and the lanes."""
    ends: list[float] = []
    parts = []
    max_lanes, max_words, longest = 4, 12, 48
    for at, words in marks[:max_words]:
        short = words if len(words) <= longest else words[: longest - 1] + "…"
        width, x = _CHART.character * len(short) + 10.0, x_axis.at(at)
        start = max(min(x - 2.0, x_axis.end - width), 0.0)
        free = [i for i, end in enumerate(ends) if end <= start]
        if not free and len(ends) == max_lanes:
            continue
        lane = free[0] if free else len(ends)
        ends[lane : lane + 1] = [start + width]
        parts.append(
            words_at(start, 16.0 + _CHART.lane * lane, short, anchor="start", kind="mark-words")
        )
    return parts, len(ends)


def _legend(series: Series, marks: Sequence[tuple[float, str]]) -> str:
    """Return what line, band, level and marks are."""
    items = [(f'stroke="{ACCENT}" stroke-width="2"', series.y_label)]
    if series.sigma is not None:
        items.append((f'stroke="{BAND}" stroke-width="11"', "± 1 σ"))
    level = _level_of(series)
    if level is not None:
        items.append((f'stroke="{QUIET}"{_DASHED}', level[0]))
    if marks:
        more = "event" if len(marks) == 1 else f"{len(marks)} events"
        items.append((f'stroke="{OUTLIER}" stroke-width="1.6" stroke-dasharray="3 3"', more))
    drawn = "".join(f"<li>{_key(style)}{escape(words)}</li>" for style, words in items if words)
    return f'<ul class="legend">{drawn}</ul>'


def _key(style: str) -> str:
    return (
        '<svg class="key" viewBox="0 0 28 12" aria-hidden="true">'
        f'<path d="M0 6h28" fill="none" {style}/></svg>'
    )
