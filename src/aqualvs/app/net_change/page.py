"""`net_change.html`: what changed, on one page that opens anywhere, without a network."""

import base64
import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from aqualvs import __version__
from aqualvs.app import report_html as html
from aqualvs.app.disk import replace_text
from aqualvs.app.net_change.cells import Growth
from aqualvs.app.net_change.comparison import Comparison, OnWall
from aqualvs.app.net_change.hole_sites import HoleState, Site
from aqualvs.app.net_change.words import (
    by_state,
    place_words,
    size_words,
    state_title,
    summary_lines,
    verdict,
)
from aqualvs.app.report_findings import Card
from aqualvs.app.report_words import signed
from aqualvs.app.runfile import now

_NONE = "–"
_WEEK = 7.0
_LONG = 30
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")


def write_page(path: Path, picture: Path, result: Comparison, origins: Mapping[str, str]) -> None:
    """Write the page.

    Parameters
    ----------
    path : Path
    picture : Path
        Of the map, which goes into the page.
    result : Comparison
    origins : mapping
        Folder of a run to what told its date.

    Raises
    ------
    OSError
        As the system says it.
    """
    first, last = result.dates[0], result.dates[-1]
    template = files("aqualvs.app.net_change").joinpath("assets", "net_change.html")
    lines = [line for line in summary_lines(result) if not line.startswith("warning: ")]
    parts = {
        "css": html.asset("report.css"),
        "title": escape(f"The net from {first} to {last}"),
        "subtitle": escape(f"{len(result.surveys)} dives on {len(result.dates)} dates"),
        "cards": html.cards(_cards(result)),
        "warnings": html.notice([_sentence(one) for one in result.warnings]),
        "sentences": "\n".join(_paragraph(line) for line in lines),
        "picture": base64.b64encode(picture.read_bytes()).decode("ascii"),
        "holes": _holes(result),
        "dates": _dates(result),
        "dives": _dives(result, origins),
        "footer": escape(f"Written {now()} by aqualvs {__version__}."),
    }
    text = Template(template.read_text(encoding="utf-8")).substitute(parts)
    replace_text(path, text)


def _cards(result: Comparison) -> list[Card]:
    wall = result.wall
    growth = result.rate if wall is None else wall.growth
    found = []
    if growth is not None:
        week, sigma = 100.0 * _WEEK * growth.value, 100.0 * _WEEK * growth.sigma
        value = signed(f"{week:+.1f} %")
        found.append(Card("Fouling a week", value, f"± {sigma:.1f} %: {verdict(growth)}"))
    if wall is None:
        return found
    counts = {state: len(some) for state, some in by_state(wall.sites).items()}
    new, grown = counts.get(HoleState.NEW, 0), counts.get(HoleState.GROWN, 0)
    first = counts.get(HoleState.FIRST_LOOK, 0)
    found.append(Card("New holes", str(new), f"{grown} grown, {first} where none looked before"))
    unseen = counts.get(HoleState.NOT_PASSED, 0)
    gone = counts.get(HoleState.GONE, 0)
    found.append(Card("Holes gone", str(gone), f"{unseen} more were not passed this time"))
    return found


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:] + "."


def _paragraph(line: str) -> str:
    style = ' style="margin-left: 1.5em"' if line.startswith("  ") else ""
    return f"<p{style}>{_typeset(line.strip())}</p>"


def _typeset(words: str) -> str:
    """Return a line of the summary as HTML: minus signs, but the hyphens of dates stay."""
    return escape(_MINUS.sub("\u2212", words.replace("->", "\u2192")))


def _holes(result: Comparison) -> str:
    wall = result.wall
    if wall is None:
        return (
            '<p class="note">Places are not compared, so no hole can be found again. All are in '
            "holes_change.csv.</p>"
        )
    if not wall.sites:
        return "<p>None was found on any date.</p>"
    rows = [_hole_row(one, wall) for some in by_state(wall.sites).values() for one in some]
    head = (
        "what became of it",
        "place",
        "diameter",
        "first seen",
        "last seen",
        "looked at before",
        "looked at now",
    )
    table = html.table(head, rows, texts=2)
    if len(rows) <= _LONG:
        return table
    return f"<details><summary>All {len(rows)} holes</summary>{table}</details>"


def _hole_row(one: Site, wall: OnWall) -> tuple[str, ...]:
    dates = wall.history.dates
    seen = np.flatnonzero(np.isfinite(one.sizes))
    return (
        state_title(one.state),
        place_words(one.place, wall.frame),
        size_words(one).replace("->", "\u2192"),
        dates[seen[0]].isoformat(),
        dates[seen[-1]].isoformat(),
        f"{100.0 * float(one.looked[:-1].max()):.0f} %",
        f"{100.0 * float(one.looked[-1]):.0f} %",
    )


def _dates(result: Comparison) -> str:
    wall = result.wall
    on_wall: dict[object, Growth | None] = {}
    if wall is not None:
        on_wall = dict(zip(wall.history.dates, wall.means, strict=True))
    rows = [
        (day.isoformat(), _share(on_wall.get(day)), _share(whole))
        for day, whole in zip(result.dates, result.whole, strict=True)
    ]
    head = ("date", "solidity of what was seen on all dates", "of all that was seen")
    return html.table(head, rows)


def _share(one: Growth | None) -> str:
    return _NONE if one is None else f"{100.0 * one.value:.1f} ± {100.0 * one.sigma:.1f} %"


def _dives(result: Comparison, origins: Mapping[str, str]) -> str:
    shifts = {}
    if result.wall is not None:
        wall = result.wall
        for one, shift in zip(wall.placed, wall.shifts, strict=True):
            shifts[one.survey.folder] = (shift, wall.frame)
    rows = []
    for survey in result.surveys:
        found = shifts.get(survey.folder)
        words = [_NONE, _NONE]
        if found is not None and not found[0].sigma.any():
            words = ["as logged", "as logged"]
        elif found is not None:
            shift, frame = found
            scale, unit = (np.rad2deg(1.0 / frame.radius), "°") if frame.round else (1.0, " m")
            ends = ((scale, unit), (1.0, " m"))
            words = [
                signed(f"{k * value:+.2f} ± {k * sigma:.2f}{u}")
                for (k, u), value, sigma in zip(ends, shift.value, shift.sigma, strict=True)
            ]
        rows.append(
            (
                str(survey.folder),
                survey.date.isoformat(),
                origins.get(str(survey.folder), ""),
                str(len(survey.stretches.along)),
                str(len(survey.holes.number)),
                *words,
            )
        )
    head = ("dive", "date", "told by", "stretches", "holes", "shifted along", "shifted down")
    return html.table(head, rows, texts=3)
