"""Page, summary and figures of a simulated run.

The figures follow figures 22 and 23 of the paper (Constantinou, Georgiades and Loizou, Robotics
2021, 10, 126). Matplotlib is imported when a figure is drawn, and only its Agg canvas, which needs
no display.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.follow.log import (
    JUMP,
    LoopLog,
    effort_measures,
    hold_measures,
    safety_measures,
    thruster_measures,
)
from aqualvs.geometry.arrays import FloatArray, runs_of
from aqualvs.report import html
from aqualvs.report.figure_style import BLUE, DARK, GREY, ORANGE, STYLE, new_canvas, save_figures
from aqualvs.results.files import replace_text, writing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Shades of frames without a posture, and of those at which the safety gate changed the effort.
_LOST, _GUARDED = "#f3c9bd", "#f6e3a8"
# Least span of an axis, in metres and degrees, so that noise does not fill it.
_MIN_DEPTH, _MIN_RANGE, _MIN_ANGLE = 0.2, 0.1, 6.0


FIGURE_FILES = ("figure_22.png", "figure_23.png")


def drawn_follow_figures(log: LoopLog) -> "dict[str, Figure]":
    """Return the figures by their names without ending, not yet written."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        return {"figure_22": _motion(log), "figure_23": _control(log)}


def _motion(log: LoopLog) -> "Figure":
    """Draw figure 22: depth, range, heading and target yaw."""
    figure, axes = _panels(3, 6.4)
    time_s = log.column("time_s")
    depth, ranges, angles = axes
    depth.plot(time_s, log.column("depth"), color=BLUE, linewidth=0.9)
    _name(depth, "depth (m)", _MIN_DEPTH)
    depth.invert_yaxis()
    ranges.plot(time_s, log.column("measured_range"), color=BLUE, linewidth=0.9)
    _name(ranges, "range (m)", _MIN_RANGE)
    heading = np.degrees(np.unwrap(log.column("heading")))
    angles.plot(time_s, heading, color=ORANGE, linewidth=0.9, label="heading")
    yaw = np.degrees(log.column("measured_yaw"))
    angles.plot(time_s, yaw, color=BLUE, linewidth=0.9, label="target yaw")
    _name(angles, "angle (deg)", _MIN_ANGLE)
    _legend(angles)
    _finish(axes, log, time_s)
    return figure


def _control(log: LoopLog) -> "Figure":
    """Draw figure 23: setpoint, measurement and command of both controllers."""
    figure, axes = _panels(4, 8.0)
    time_s = log.column("time_s")
    _loop(axes[0], log, "range", 1.0)
    _name(axes[0], "range (m)", _MIN_RANGE)
    _command(axes[1], time_s, log.column("forward"), "forward effort (1 is full)")
    _loop(axes[2], log, "yaw", 180.0 / np.pi)
    _name(axes[2], "target yaw (deg)", _MIN_ANGLE)
    _command(axes[3], time_s, log.column("turn"), "yaw effort (1 is full)")
    _legend(axes[0])
    _finish(axes, log, time_s)
    return figure


def _loop(axes: "Axes", log: LoopLog, name: str, unit: float) -> None:
    time_s = log.column("time_s")
    measured = unit * log.column(f"measured_{name}")
    axes.plot(time_s, measured, color=BLUE, linewidth=0.8, alpha=0.55, label="measured")
    axes.plot(time_s, unit * log.column(name), color=DARK, linewidth=1.0, label="true")
    wanted = unit * log.column(f"wanted_{name}")
    axes.plot(time_s, wanted, color=ORANGE, linewidth=1.2, linestyle="--", label="setpoint")


def _command(axes: "Axes", time_s: FloatArray, effort: FloatArray, name: str) -> None:
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.plot(time_s, effort, color=DARK, linewidth=0.7)
    most = max(0.2, 1.15 * float(np.abs(effort).max()))
    axes.set(ylim=(-most, most), ylabel=name)


def _panels(n: int, height_in: float) -> "tuple[Figure, list[Axes]]":
    figure = new_canvas(7.2, height_in)
    axes = figure.subplots(n, 1, sharex=True)
    figure.align_ylabels(axes)
    return figure, list(axes)


def _name(axes: "Axes", label: str, least: float) -> None:
    """Label an axis, and extend it to a span of at least `least`."""
    axes.set_ylabel(label)
    low, high = axes.get_ylim()
    short = least - abs(high - low)
    if short > 0.0:
        axes.set_ylim(low - 0.5 * short, high + 0.5 * short)


def _legend(axes: "Axes") -> None:
    """Put the legend above the axes, off the curves."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.1)


def _finish(axes: "list[Axes]", log: LoopLog, time_s: FloatArray) -> None:
    """Shade frames without a posture and those at which the safety gate stepped in; name both."""
    lost = np.array([row.refusal != "" for row in log.rows])
    guarded = np.array([row.reason != "" for row in log.rows]) & ~lost
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    for one in axes:
        for here, colour in ((lost, _LOST), (guarded, _GUARDED)):
            for start, end in runs_of(here):
                one.axvspan(time_s[start], time_s[end] + step_s, color=colour, linewidth=0)
        one.set_xlim(float(time_s[0]), float(time_s[-1]))
    notes = (("no posture shaded red", lost), ("safety gate shaded yellow", guarded))
    words = ", ".join(words for words, here in notes if here.any())
    axes[-1].set_xlabel("time (s)" + (f"   ({words})" if words else ""))


PAGE = "follow.html"
SETTLED_S = 10.0
"""Time, in seconds, from which on errors count: a run begins at rest in moving water."""


def summary(log: LoopLog) -> list[tuple[str, str]]:
    """Return the results of a run as pairs of name and value."""
    start_s = _settled_s(log)
    hold, safety = hold_measures(log, start_s), safety_measures(log)
    figures = [
        (
            f"range error, rms from {start_s:.0f} s on",
            f"{1e3 * hold.range_rms:.1f} mm (max {1e3 * hold.range_worst:.0f} mm)",
        ),
        ("yaw error, rms", f"{math.degrees(hold.yaw_rms):.2f} deg"),
        *_efforts(log, start_s),
        ("frames without a posture", f"{hold.n_lost}"),
        ("frames at which the safety gate stepped in", f"{hold.n_guarded}"),
        (
            "least distance from hull to net",
            f"{safety.min_clearance:.2f} m" + (" - CONTACT" if safety.contact else ""),
        ),
        ("share of the frames at which it was steered", f"{100.0 * safety.steered_share:.0f} %"),
    ]
    if safety.n_blind:
        late = f"{safety.neutral_late:.2f} s after the last posture, at most"
        figures.append((f"neutral in {safety.n_blind} blind stretches", late))
    if math.isfinite(safety.lost_s):
        figures.append(("LOST", f"the net, for good, at {safety.lost_s:.1f} s"))
    return figures


def _settled_s(log: LoopLog) -> float:
    end_s = log.rows[-1].time_s
    return SETTLED_S if end_s > 2.0 * SETTLED_S else 0.5 * end_s


def _headline(log: LoopLog) -> tuple[list[html.Card], list[str]]:
    """Return the cards and the warnings of the page."""
    start_s = _settled_s(log)
    hold, safety = hold_measures(log, start_s), safety_measures(log)
    since = f"rms from {start_s:.0f} s on"
    cards = [
        html.Card(
            "Range error",
            f"{1e3 * hold.range_rms:.1f} mm",
            f"{since}; max {1e3 * hold.range_worst:.0f} mm",
        ),
        html.Card("Yaw error", f"{math.degrees(hold.yaw_rms):.2f}°", since),
        html.Card("Hull to net", f"{safety.min_clearance:.2f} m", "least distance of the run"),
    ]
    warnings = []
    if safety.contact:
        warnings.append("The vehicle touched the net.")
    if math.isfinite(safety.lost_s):
        warnings.append(f"The net was lost for good at {safety.lost_s:.1f} s.")
    return cards, warnings


def _efforts(log: LoopLog, start_s: float) -> list[tuple[str, str]]:
    """Return rows on reversals and jumps of the thrusters."""
    found = {
        "horizontal": thruster_measures(log, start_s),
        "yaw": effort_measures(log, "turn", start_s),
    }
    reversals = ", ".join(f"{name} {one.reversals:.0f}" for name, one in found.items())
    jumps = ", ".join(f"{name} {one.jumps:.0f}" for name, one in found.items())
    return [
        ("reversals of the thrusters a minute", reversals),
        (f"jumps of the thrusters above {JUMP:g} a minute", jumps),
    ]


def summary_lines(log: LoopLog, setup: str) -> list[str]:
    """Return the summary as lines for a terminal; `setup` is the first."""
    table = summary(log)
    width = max(len(name) for name, _ in table)
    return [setup, *(f"  {name:<{width}}  {value}" for name, value in table)]


def write_report(log: LoopLog, setup: str, out: Path) -> Path:
    """Draw the figures, write the page beside them, and return its path.

    `setup`: the setup of the simulation in one line.

    Raises `OutputError` if a file cannot be written.
    """
    with writing(out):
        figures = save_figures(drawn_follow_figures(log), out, dpi=160)
    cards, warnings = _headline(log)
    content = {
        "title": "Hold and follow, simulated",
        "subtitle": setup,
        "cards": html.cards(cards),
        "warnings": html.notice(warnings),
        "facts": html.fact_table(summary(log)),
        "figures": [
            (html.data_url(one.read_bytes(), "png"), _CAPTIONS[one.name]) for one in figures
        ],
    }
    path = out / PAGE
    with writing(path):
        replace_text(path, html.page("follow.html", content))
    return path


_CAPTIONS = {
    "figure_22.png": "Depth, range, heading and target yaw over time.",
    "figure_23.png": "Range and yaw control: setpoint, measurement, truth and effort.",
}
