"""`net_change.html` and its map: the changes of a net on one page, without a network.

The map shows growth by colour and holes by what became of them.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from aqualvs import __version__
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.net_survey.comparison import Comparison, HoleState, OnWall, Site
from aqualvs.net_survey.frames import SurveyShift, WallFrame
from aqualvs.net_survey.growth import Growth
from aqualvs.net_survey.tables import (
    STATE_TITLES,
    bearing_deg,
    by_state,
    dives_text,
    place_text,
    rate_text,
    size_text,
    summary_lines,
    verdict,
)
from aqualvs.report import html
from aqualvs.report.figure_style import DARK, PALE, STYLE
from aqualvs.report.html import Card
from aqualvs.results.files import replace_text
from aqualvs.results.run_request import now
from aqualvs.text import sentence, signed, with_sign

_WEEK = 7.0
# From green (less) over white to brown (more); told apart by colour-blind eyes.
_COLOURS = "BrBG_r"
_MIN_SCALE = 1.0
_GREY, _SEA = "#d5dade", "#ffffff"
_LABELLED = 24
_EDGE: dict[str, Any] = {"linestyle": "", "markeredgecolor": DARK, "markeredgewidth": 0.9}
_MARKS: dict[HoleState, dict[str, Any]] = {
    HoleState.NEW: {**_EDGE, "marker": "o", "markerfacecolor": "#d7191c", "markersize": 10},
    HoleState.GROWN: {**_EDGE, "marker": "^", "markerfacecolor": "#f28e2b", "markersize": 10},
    HoleState.SMALLER: {**_EDGE, "marker": "v", "markerfacecolor": "#9ecae1", "markersize": 9},
    HoleState.SAME: {**_EDGE, "marker": "o", "markerfacecolor": "#4a5560", "markersize": 7},
    HoleState.GONE: {**_EDGE, "marker": "X", "markerfacecolor": "#ffffff", "markersize": 10},
    HoleState.FIRST_LOOK: {**_EDGE, "marker": "D", "markerfacecolor": "#f7c6c7", "markersize": 8},
    HoleState.NOT_PASSED: {**_EDGE, "marker": "s", "markerfacecolor": "#c9ced3", "markersize": 8},
}
_STYLE: dict[Any, Any] = {**STYLE, "axes.grid": False, "hatch.linewidth": 0.5}


def draw_change(result: Comparison, path: Path) -> None:
    """Draw the map; where places cannot be compared, the means date by date.

    Raises `OSError` as the system says it.
    """
    dpi = 200
    with rc_context(_STYLE):
        figure = _dates(result) if result.wall is None else _map(result.wall)
        figure.savefig(path, dpi=dpi)


def _map(wall: OnWall) -> Figure:
    raster = wall.history.raster
    columns = _columns(wall)
    low = raster.low[1] - 0.3 * raster.size[1]
    high = raster.low[1] + (raster.shape[1] + 0.3) * raster.size[1]
    length, tall = len(columns) * float(raster.size[0]), float(high - low)
    tallest_in, min_ratio, max_rows = 7.0, 0.16, 6
    n_rows = min(max(math.ceil(math.sqrt(min_ratio * length / tall)), 1), max_rows)
    per_row = math.ceil(len(columns) / n_rows)
    span = per_row * float(raster.size[0])
    width_in, panel_in, around_in, row_gap_in = 11.0, 9.2, 1.7, 0.45
    height = min(panel_in * tall / span, tallest_in)
    size = (width_in, n_rows * (height + row_gap_in) + around_in)
    figure = Figure(figsize=size, facecolor="white", layout="constrained")
    axes = figure.subplots(n_rows, 1, squeeze=False)[:, 0]
    shades = _shades(wall)
    for row, one in enumerate(axes):
        _cells(one, wall, columns, shades)
        one.set_xlim(row * span, (row + 1) * span)
        one.set_ylim(high, low)
        _sites(one, wall, columns)
        _axis(one, wall, columns, last=row == n_rows - 1)
    bar = figure.colorbar(shades, ax=list(axes), shrink=min(1.0, 2.6 / size[1] + 0.3), pad=0.015)
    bar.set_label("change of solidity,\n% of the net's area a week")
    _put_title(figure, _title(wall))
    _legend(figure, wall)
    return figure


def _columns(wall: OnWall) -> IntArray:
    """Return the columns of cells in the order in which they are drawn.

    Round a net the widest gap that nothing was seen in is cut out.
    """
    n = wall.history.raster.shape[0]
    seen = np.flatnonzero(wall.history.known.reshape(n, -1).any(axis=1))
    if not len(seen) or not wall.frame.round:
        return np.arange(n)
    gaps = np.diff(np.append(seen, seen[0] + n))
    widest = int(np.argmax(gaps))
    count = n - int(gaps[widest]) + 1
    return np.asarray((seen[(widest + 1) % len(seen)] + np.arange(count)) % n)


def _shades(wall: OnWall) -> ScalarMappable:
    rates = [abs(100.0 * _WEEK * one.per_day.value) for one in wall.cells]
    most = max(float(np.quantile(rates, 0.98)) if rates else 0.0, _MIN_SCALE)
    return ScalarMappable(Normalize(-most, most), _COLOURS)


def _cells(axes: Axes, wall: OnWall, columns: IntArray, shades: ScalarMappable) -> None:
    raster, changes = wall.history.raster, {one.cell: one for one in wall.cells}
    known = np.asarray(wall.history.known.any(axis=1)).reshape(raster.shape)[columns]
    axes.set_facecolor(_SEA)
    width, height = map(float, raster.size)
    for x, row in np.argwhere(known).tolist():
        cell = int(columns[x]) * raster.shape[1] + row
        corner = (x * width, float(raster.low[1]) + row * height)
        one = changes.get(cell)
        if one is None:
            style: dict[str, Any] = {"facecolor": _GREY, "hatch": "////", "edgecolor": "white"}
        else:
            rate = np.array([100.0 * _WEEK * one.per_day.value])
            style = {"facecolor": shades.to_rgba(rate)[0], "edgecolor": "white"}
        axes.add_patch(Rectangle(corner, width, height, linewidth=0.4, **style))
        if one is not None and one.changed:
            middle = (corner[0] + 0.5 * width, corner[1] + 0.5 * height)
            axes.plot(*middle, ".", color=DARK, markersize=2.2)


def _sites(axes: Axes, wall: OnWall, columns: IntArray) -> None:
    low, high = axes.get_xlim()
    many = len(wall.sites) > _LABELLED
    for site in sorted(wall.sites, key=lambda one: one.state is not HoleState.SAME):
        x = _drawn(site.place, wall, columns)
        if not low <= x <= high:
            continue
        axes.plot(x, site.place[1], **_MARKS[site.state])
        if many and site.state not in (HoleState.NEW, HoleState.GROWN):
            continue
        size = 1e3 * site.sizes[np.isfinite(site.sizes)][-1]
        axes.annotate(
            f"{size:.0f} mm",
            (x, site.place[1]),
            xytext=(0.0, 7.0),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            fontweight="bold",
            bbox={"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75},
        )


def _drawn(place: FloatArray, wall: OnWall, columns: IntArray) -> float:
    """Return where along the drawn columns a place is."""
    raster = wall.history.raster
    size = float(raster.size[0])
    at = (float(place[0]) - float(raster.low[0])) / size
    if not wall.frame.round:
        return size * at
    return size * float(np.mod(at - columns[0] + 0.5, raster.shape[0]) - 0.5)


def _axis(axes: Axes, wall: OnWall, columns: IntArray, *, last: bool) -> None:
    raster, frame = wall.history.raster, wall.frame
    axes.set_ylabel("depth, m")
    axes.set_aspect("equal")
    if frame.round:
        start = float(columns[0] * raster.size[0])
        low, high = axes.get_xlim()
        ends = np.rad2deg(np.array([low + start, high + start]) / frame.radius)
        step = next(s for s in (2.0, 5.0, 10.0, 15.0, 30.0, 45.0) if np.ptp(ends) / s < 14)
        degrees = np.arange(np.ceil(ends[0] / step), np.floor(ends[1] / step) + 1) * step
        at = np.deg2rad(degrees) * frame.radius - start
        names = [f"{bearing_deg(x + start, frame):.0f}°" for x in at]
        axes.set_xticks(at, names)
    else:
        low = float(raster.low[0])
        axes.xaxis.set_major_formatter(lambda value, _: f"{value + low:g}")
    if last:
        axes.set_xlabel("bearing of the net" if frame.round else "along the net to the right, m")


def _title(wall: OnWall) -> str:
    dates = wall.history.dates
    words = f"What changed on the net from {dates[0]} to {dates[-1]}"
    if wall.growth is None:
        return words
    return f"{words}\n{rate_text(wall.growth)}: {verdict(wall.growth)}"


def _legend(figure: Figure, wall: OnWall) -> None:
    states = {one.state for one in wall.sites}
    shown: dict[str, Line2D | Patch] = {
        "new hole" if state is HoleState.NEW else state.value: Line2D([], [], **style)
        for state, style in _MARKS.items()
        if state in states
    }
    if any(one.changed for one in wall.cells):
        shown["changed beyond chance"] = Line2D(
            [], [], linestyle="", marker=".", color=DARK, markersize=4
        )
    known = wall.history.known.sum(axis=1)
    if np.any(known == 1):
        shown["seen on one date only"] = Patch(facecolor=_GREY, edgecolor="white", hatch="////")
    if shown:
        figure.legend(
            list(shown.values()), list(shown), loc="outside lower left", ncols=min(len(shown), 6)
        )


def _dates(result: Comparison) -> Figure:
    figure = Figure(figsize=(8.0, 4.0), facecolor="white", layout="constrained")
    axes = figure.subplots()
    known = [(d, one) for d, one in zip(result.dates, result.whole, strict=True) if one]
    days = [day.toordinal() for day, _ in known]
    # No date is known where solidity was measured nowhere.
    means = np.array([(one.value, one.sigma) for _, one in known]).reshape(-1, 2)
    values, sigmas = 100.0 * means.T
    axes.errorbar(days, values, sigmas, fmt="o-", color=DARK, capsize=4.0)
    axes.set_xticks(days, [day.isoformat() for day, _ in known])
    axes.margins(x=0.12)
    axes.set_ylabel("solidity of all that was seen, %")
    axes.grid(color=PALE, linewidth=0.6)
    _put_title(figure, "Whole dives: places on the net are not compared")
    return figure


def _put_title(figure: Figure, words: str) -> None:
    figure.suptitle(words, x=0.01, ha="left", fontsize=12, fontweight="bold")


_NONE = "–"
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")


def write_page(path: Path, picture: Path, result: Comparison, origins: Mapping[str, str]) -> None:
    """Write the page, with the picture of the map in it.

    `origins`: folder of a run to what told its date. Raises `OSError` as the system says it.
    """
    first, last = result.dates[0], result.dates[-1]
    folders = tuple(str(one.folder) for one in result.surveys)
    lines = [line for line in summary_lines(result) if not line.startswith("warning: ")]
    content = {
        "title": f"The net from {first} to {last}",
        "subtitle": dives_text(result),
        "footer": f"Written {html.moment(now())} by aqualvs {__version__}.",
        "cards": html.cards(_cards(result)),
        "warnings": html.notice(
            # A path keeps its letters.
            [f"{one}." if one.startswith(folders) else sentence(one) for one in result.warnings]
        ),
        # Minus signs, but the hyphens of dates stay.
        "sentences": [_MINUS.sub("\u2212", line.replace("->", "\u2192")) for line in lines],
        "picture": html.data_url(picture.read_bytes(), "png"),
        "holes": _holes(result),
        "dates": _table_of_dates(result),
        "dives": _dives(result, origins),
    }
    replace_text(path, html.page("net_change.html", content))


def _cards(result: Comparison) -> list[Card]:
    wall = result.wall
    growth = result.rate if wall is None else wall.growth
    found = []
    if growth is not None:
        week, sigma = 100.0 * _WEEK * growth.value, 100.0 * _WEEK * growth.sigma
        value = signed(f"{with_sign(week, 1)} %")
        found.append(Card("Fouling a week", value, f"± {sigma:.1f} %: {verdict(growth)}"))
    if wall is None:
        return found
    n = Counter(one.state for one in wall.sites)
    words = f"{n[HoleState.GROWN]} grown, {n[HoleState.FIRST_LOOK]} where none looked before"
    found.append(Card("New holes", str(n[HoleState.NEW]), words))
    words = f"{n[HoleState.NOT_PASSED]} more were not passed this time"
    found.append(Card("Holes gone", str(n[HoleState.GONE]), words))
    return found


def _holes(result: Comparison) -> html.Raw:
    wall = result.wall
    if wall is None:
        return html.Raw(
            '<p class="note">Places are not compared, so no hole can be found again. All are in '
            "holes_change.csv.</p>"
        )
    if not wall.sites:
        return html.Raw("<p>None was found on any date.</p>")
    rows = [_hole_row(one, wall) for some in by_state(wall.sites).values() for one in some]
    head = (
        *("what became of it", "place", "diameter"),
        *("first seen", "last seen", "looked at before", "looked at now"),
    )
    return html.folded(html.table(head, rows, texts=2), len(rows), "holes", longest=30)


def _hole_row(one: Site, wall: OnWall) -> tuple[str, ...]:
    dates = wall.history.dates
    seen = np.flatnonzero(np.isfinite(one.sizes))
    return (
        STATE_TITLES[one.state],
        place_text(one.place, wall.frame),
        size_text(one).replace("->", "\u2192"),
        dates[seen[0]].isoformat(),
        dates[seen[-1]].isoformat(),
        f"{100.0 * float(one.looked[:-1].max()):.0f} %",
        f"{100.0 * float(one.looked[-1]):.0f} %",
    )


def _table_of_dates(result: Comparison) -> html.Raw:
    on_wall: dict[object, Growth | None] = {}
    if (wall := result.wall) is not None:
        on_wall = dict(zip(wall.history.dates, wall.means, strict=True))
    rows = [
        (day.isoformat(), _share(on_wall.get(day)), _share(whole))
        for day, whole in zip(result.dates, result.whole, strict=True)
    ]
    head = ("date", "solidity of what was seen on all dates", "of all that was seen")
    return html.table(head, rows)


def _share(one: Growth | None) -> str:
    return _NONE if one is None else f"{100.0 * one.value:.1f} ± {100.0 * one.sigma:.1f} %"


def _dives(result: Comparison, origins: Mapping[str, str]) -> html.Raw:
    shifts: dict[Path, Sequence[str]] = {}
    if (wall := result.wall) is not None:
        for one, shift in zip(wall.placed, wall.shifts, strict=True):
            shifts[one.survey.folder] = _shift_cells(shift, wall.frame)
    rows = [
        (
            *(str(survey.folder), survey.date.isoformat(), origins.get(str(survey.folder), "")),
            str(len(survey.stretches.along)),
            str(len(survey.holes.number)) if survey.searched else "not searched for",
            *shifts.get(survey.folder, (_NONE, _NONE)),
        )
        for survey in result.surveys
    ]
    head = ("dive", "date", "date from", "stretches", "holes", "shifted along", "shifted down")
    return html.table(head, rows, texts=3)


def _shift_cells(shift: SurveyShift, frame: WallFrame) -> Sequence[str]:
    if not shift.sigma.any():
        return "as logged", "as logged"
    scale, unit = (np.rad2deg(1.0 / frame.radius), "°") if frame.round else (1.0, " m")
    return [
        signed(f"{with_sign(k * value, 2)} ± {k * sigma:.2f}{u}")
        for k, u, value, sigma in zip(
            (scale, 1.0), (unit, " m"), shift.value, shift.sigma, strict=True
        )
    ]
