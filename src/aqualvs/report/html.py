"""HTML parts of a run's page, made from its numbers; all text from files is escaped here."""

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.charts import reason_counts
from aqualvs.report.findings import Card, errors_against
from aqualvs.report.frames import SampleFrame
from aqualvs.report.points import PointSummary
from aqualvs.report.run_data import LaserFacts, Track, facts
from aqualvs.scanning.scan import Label
from aqualvs.text import LABEL_COLOURS, LABEL_WORDS, clock, laser_colour, signed

_MARKS = ("●", "■", "▲", "★", "□", "✕", "◆", "○")


def asset(name: str) -> str:
    """Return the text of a file that comes with the package."""
    return files("aqualvs.report").joinpath("assets", name).read_text(encoding="utf-8")


def page(parts: Mapping[str, str], template: str = "report.html") -> str:
    """Fill a template that comes with the package; `parts` must be HTML already."""
    return Template(asset(template)).substitute(parts)


def embedded_json(data: object) -> str:
    """Return JSON that is safe inside a script element.

    Raises
    ------
    ValueError
        If a number is not finite; JSON has no word for it.
    """
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def text(value: object) -> str:
    """Return something from a file as HTML text."""
    return escape(str(value))


def subtitle(run: Mapping[str, Any]) -> str:
    """Return the rig's name, the source and its picture size, as far as they are known."""
    rig, source = run.get("rig"), run.get("source")
    said = []
    if isinstance(rig, dict) and rig.get("name"):
        said.append(f"Rig “{rig['name']}”")
    if isinstance(source, dict):
        said.append(f"source {source.get('path') or source.get('name') or 'unknown'}")
        size = source.get("size_px") or [source.get("width_px"), source.get("height_px")]
        if isinstance(size, list) and all(size):
            said.append(f"{' × '.join(map(str, size))} px")
    return escape(", ".join(said))


def posture_lead(track: Track, truth: FloatArray | None) -> str:
    """Return the line above the posture's charts."""
    words = "Bands: one and two standard deviations."
    if not track.valid.all():
        words += " Grey: no posture; point at it for the reason."
    if truth is not None:
        words += " Dashed: truth."
    return words


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, texts: int = 1, tail: int = 0
) -> str:
    """Return a table of numbers (to the right) between text columns.

    The first `texts` and the last `tail` columns are text. Cells are escaped, except those that
    are `Raw`.
    """
    kinds = ["" if i < texts or i >= len(head) - tail else ' class="n"' for i in range(len(head))]
    top = "".join(f"<th{kind}>{escape(cell)}</th>" for kind, cell in zip(kinds, head, strict=True))
    body = "".join(
        "<tr>"
        + "".join(f"<td{kind}>{_cell(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
        + "</tr>\n"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead>\n{body}</table></div>'


class Raw(str):
    """Text that is HTML already."""

    __slots__ = ()


def cards(items: Iterable[Card]) -> str:
    """Return the cards of the headline."""
    return "\n".join(
        f'<div class="card"><div class="name">{escape(card.name)}</div>'
        f'<div class="value">{escape(card.value)}</div>'
        f'<div class="note">{escape(card.note)}</div></div>'
        for card in items
    )


def notice(warnings: Sequence[str]) -> str:
    """Return the box of warnings, or the all-clear."""
    if not warnings:
        return '<div class="notice"><p>Nothing to warn of.</p></div>'
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f'<div class="notice warn"><p><b>Please note</b></p><ul>{items}</ul></div>'


def truth_view(track: Track, truth: FloatArray | None) -> str:
    """Return the errors against truth and the place of their chart; nothing without truth."""
    if truth is None:
        return ""
    rms, worst, count = errors_against(truth, track.posture)
    if not count:
        return '<p class="note">No frame has both a posture and truth.</p>'
    scale = (1e3, 1.0, 1.0)
    rows = [
        (f"{name}, {unit}", f"{s * r:.{digits}f}", f"{s * w:.{digits}f}")
        for name, unit, digits, s, r, w in zip(
            ("range", "pitch", "yaw"), ("mm", "°", "°"), (2, 3, 3), scale, rms, worst, strict=True
        )
    ]
    relative = np.abs(track.posture[:, 0] / truth[:, 0] - 1.0)
    relative = 100.0 * relative[np.isfinite(relative)]
    rows.append(("range, %", f"{np.sqrt((relative**2).mean()):.3f}", f"{relative.max():.3f}"))
    heading = f"<h3>Error against truth, {count} frames</h3>"
    return (
        heading
        + table(("", "rms", "greatest"), rows)
        + '<p class="note">Bands: one and two standard deviations as the run states them.</p>\n'
        '<div class="chart" id="chart-error"></div>'
    )


def plane_view(lasers: list[LaserFacts], has_points: bool) -> str:
    """Return the slider and a place for each laser's chart, or why there is none."""
    if not has_points:
        return '<p class="note">The run left no points.</p>'
    known = [index for index, laser in enumerate(lasers) if laser.known]
    if not known:
        return '<p class="note">The laser planes are unknown, so there is no such view.</p>'
    places = "\n".join(f'<div class="chart" id="chart-plane-{index}"></div>' for index in known)
    return (
        '<p class="lead">Each laser’s points in its own plane, seen from the side to which its '
        "normal points: y leads forward, away from the dome. The dotted line is the target plane "
        "of the posture.</p>\n"
        '<div class="controls"><button type="button" id="plane-back" aria-label="previous frame">'
        '‹</button><input type="range" id="plane-slider" min="0" max="0" step="1" '
        'aria-label="sample frame"><button type="button" id="plane-next" aria-label="next frame">'
        f'›</button></div>\n<p id="plane-words"></p>\n{_label_legend()}\n'
        f'<div class="grid" id="plane-grid">{places}</div>'
    )


def cloud_view(points: PointSummary | None, planes_known: bool) -> str:
    """Return the place of the cloud, or why there is none."""
    if points is None or not len(points.cloud_in_dome):
        return '<p class="note">The run left no points on the target.</p>'
    total = int(points.on_target.sum())
    shown = len(points.cloud_in_dome)
    amount = f"All {total:,}" if shown == total else f"A random {shown:,} of {total:,}"
    buttons = ""
    if planes_known:
        buttons = (
            '<div class="controls"><button type="button" data-cloud="dive">whole dive</button>'
            '<button type="button" data-cloud="frame">the frame chosen above</button></div>'
        )
    return (
        f'<p class="lead">{amount} target points, as seen from the vehicle (x right, y forward, z '
        "up; the dome is the small black hemisphere). Drag to turn, scroll or pinch to zoom.</p>\n"
        f'{buttons}<div class="chart screen" id="chart-cloud"></div>'
        '<img class="paper" id="cloud-paper" alt="the same view, for paper">'
    )


def picture_view(
    captions: Mapping[int, tuple[str, str, bool]],
    pictures: Mapping[int, SampleFrame],
    missing: str,
    names: list[str],
) -> str:
    """Return the sample frames.

    Parameters
    ----------
    captions : mapping
        Row to (heading, posture or refusal in words, whether there is a posture).
    missing : str
        Why pictures are absent.
    """
    shots = "\n".join(
        f"<figure>{_image(pictures.get(row), missing, heading)}"
        f"<figcaption><b>{escape(heading)}</b><br>"
        f"{_verdict(words, fine)}</figcaption></figure>"
        for row, (heading, words, fine) in captions.items()
    )
    lead = "Full marks: points on the target. Faint crosses: points that were rejected."
    if not pictures:
        return f'<p class="lead">{escape(missing)}</p>\n<div class="shots">{shots}</div>'
    return f'<p class="lead">{lead}</p>\n{laser_legend(names)}\n<div class="shots">{shots}</div>'


def laser_legend(names: list[str]) -> str:
    """Return the lasers' names beside their colours."""
    items = "".join(f"<li>{swatch(i)}{escape(name)}</li>" for i, name in enumerate(names))
    return f'<ul class="legend">{items}</ul>'


def quality_view(track: Track, points: PointSummary | None, names: list[str]) -> str:
    """Return the tables and the places of the charts on data quality."""
    counted = [("with a posture", int(track.valid.sum())), *reason_counts(track)]
    rows = [(words, f"{count:,}", f"{100 * count / len(track):.1f} %") for words, count in counted]
    reasons = f"<div><h3>Frames</h3>{table(('', 'frames', 'share'), rows)}</div>"
    if points is None:
        return reasons
    lasers = f"<div><h3>Points</h3>{_laser_counts(points, names)}</div>"
    charts = [
        ("chart-counts", "Target points per frame and laser", points.on_target.any()),
        ("chart-rms", "Residuals over time", points.n_squares.any()),
        ("chart-residual", "Residuals by laser", points.residual.any()),
        ("chart-quality", "Stripe quality of target points", points.quality.any()),
    ]
    places = "\n".join(
        f'<div><h3>{title}</h3><div class="chart" id="{name}"></div></div>'
        for name, title, known in charts
        if known
    )
    return (
        f'<div class="grid two tables">{reasons}{lasers}</div>\n'
        f'{laser_legend(names)}<div class="grid two">{places}</div>'
    )


def bare_view(track: Track, bare: FloatArray | None, truth: FloatArray | None) -> str:
    """Return the section on what ignoring the dome would cost; nothing without the comparison."""
    if bare is None:
        return ""
    percent = 100.0 * (bare[:, 0] / track.posture[:, 0] - 1.0)
    percent = percent[np.isfinite(percent)]
    if not len(percent):
        words = '<p class="note">No frame has a posture both ways.</p>'
        return f'<section id="bare"><h2>With and without the dome</h2>{words}</section>'
    low, middle, high = percent.min(), np.median(percent), percent.max()
    rows = [
        ("range without, relative to with", *(signed(f"{v:+.2f} %") for v in (low, middle, high)))
    ]
    text = table(("", "least", "median", "greatest"), rows)
    if truth is not None:
        text += _both_errors(track.posture, bare, truth)
    return (
        '<section id="bare"><h2>With and without the dome</h2>\n<p class="lead">The same stripe '
        "pixels, read once through the dome’s refraction and once as if the camera looked "
        f"straight into the water ({len(percent)} frames).</p>\n"
        f'<div class="chart" id="chart-bare"></div>\n{text}\n</section>'
    )


def rig_view(run: Mapping[str, Any], lasers: list[LaserFacts]) -> str:
    """Return lasers, rig, options and versions as tables."""
    head = ("laser", "normal x", "normal y", "normal z", "offset from the dome's centre, mm")
    rows = [_laser_row(i, laser) for i, laser in enumerate(lasers)]
    lasers_table = table(head, rows) if rows else ""
    blocks = []
    for title, key, skip in (
        ("Rig", "rig", ("lasers", "solved_from", "points", "history")),
        ("Source", "source", ()),
        ("Options", "options", ()),
        ("Versions", "versions", ()),
        ("Summary", "summary", ("warnings",)),
    ):
        content = run.get(key)
        if isinstance(content, dict) and content:
            blocks.append(f"<div><h3>{title}</h3>{fact_table(facts(content, skip))}</div>")
    if not lasers and not blocks:
        return '<p class="note">run.yaml does not say.</p>'
    columns = "\n".join(blocks)
    return f'{lasers_table}<div class="facts-columns">{columns}</div>'


def _verdict(words: str, fine: bool) -> str:
    kind = "" if fine else ' class="refused"'
    return f"<span{kind}>{escape(words)}</span>"


def _cell(cell: str) -> str:
    return cell if isinstance(cell, Raw) else escape(cell)


def swatch(index: int) -> str:
    """Return a patch in the colour of laser `index`."""
    return f'<span class="swatch" style="background:{laser_colour(index)}"></span>'


def _label_legend() -> str:
    items = "".join(
        f'<li><span class="mark" style="color:{LABEL_COLOURS[label]}">{_MARKS[label]}</span>'
        f"{LABEL_WORDS[label]}</li>"
        for label in Label
    )
    return f'<ul class="legend">{items}</ul>'


def _image(picture: SampleFrame | None, missing: str, heading: str) -> str:
    if picture is None:
        return f'<div class="missing">{escape(missing)}</div>'
    width, height = picture.size_px
    return (
        f'<img src="data:image/jpeg;base64,{picture.jpeg_base64}" width="{width}" '
        f'height="{height}" alt="{escape(heading)}">'
    )


def _laser_counts(points: PointSummary, names: list[str]) -> str:
    head = ("laser", "in the posture", *(LABEL_WORDS[label] for label in Label))
    used = points.on_target.sum(axis=0)
    counts = np.column_stack([used, points.labels])
    rows = [
        (Raw(swatch(index) + escape(name)), *(f"{count:,}" for count in counts[index]))
        for index, name in enumerate(names)
    ]
    return table(head, rows)


def _both_errors(dome: FloatArray, bare: FloatArray, truth: FloatArray) -> str:
    rows = []
    for name, posture in (("with the dome", dome), ("without it", bare)):
        rms, worst, count = errors_against(truth, posture)
        if count:
            rows.append((name, f"{1e3 * rms[0]:.2f} mm", f"{1e3 * worst[0]:.2f} mm", f"{count}"))
    return table(("range error against truth", "rms", "greatest", "frames"), rows)


def _laser_row(index: int, laser: LaserFacts) -> tuple[str, ...]:
    bent = " (bent sheet; the plane that fits it)" if laser.bent else ""
    name = Raw(swatch(index) + escape(laser.name + bent))
    if not np.isfinite(laser.offset):
        return name, "–", "–", "–", "–"
    return name, *(signed(f"{v:+.5f}") for v in laser.normal), signed(f"{1e3 * laser.offset:.2f}")


def fact_table(rows: Iterable[tuple[str, str]]) -> str:
    """Return names and values as a table."""
    body = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>\n" for k, v in rows)
    return f'<div class="scroll"><table class="facts">{body}</table></div>'


def footer(run: Mapping[str, Any], track: Track) -> str:
    """Return when the run took place and what made the page."""
    when = " to ".join(str(run[key]) for key in ("started", "ended") if run.get(key))
    said = f"Run from {when}. " if when else ""
    return escape(f"{said}{len(track):,} frames over {clock(float(np.ptp(track.time_s)))}.")
