"""The page and the summary of a simulated run."""

import html
import math
from dataclasses import dataclass
from pathlib import Path

from aqualvs.app.disk import replace_text, writing
from aqualvs.app.follow_figures import draw_follow_figures
from aqualvs.app.follow_sim_log import LoopLog
from aqualvs.app.follow_sim_measures import (
    JUMP,
    effort_measures,
    hold_measures,
    safety_measures,
)

PAGE = "follow.html"
SETTLED_S = 10.0
"""A run begins at rest in moving water; errors count from then on, in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """What was simulated, in the words of the page."""

    vehicle: str
    current: float
    waves: float
    rendered: bool
    fps: float

    @property
    def words(self) -> str:
        """One line."""
        eye = "rendered pictures, measured" if self.rendered else "sampled postures"
        return (
            f"{self.vehicle}, current {self.current:g} m/s, waves of {self.waves:g} m amplitude, "
            f"{eye} at {self.fps:g} Hz"
        )


def summary(log: LoopLog) -> list[tuple[str, str]]:
    """Return what a run came to, as names and values."""
    rows = log.rows
    start_s = SETTLED_S if rows[-1].time_s > 2.0 * SETTLED_S else 0.5 * rows[-1].time_s
    hold, safety = hold_measures(log, start_s), safety_measures(log)
    steered = sum(row.engaged for row in rows) / len(rows)
    figures = [
        (
            f"range error, rms from {start_s:.0f} s on",
            f"{1e3 * hold.range_rms:.1f} mm (worst {1e3 * hold.range_worst:.0f} mm)",
        ),
        ("yaw error, rms", f"{math.degrees(hold.yaw_rms):.2f} deg"),
        *_efforts(log, start_s),
        ("frames without a posture", f"{hold.n_lost}"),
        ("frames at which the safety gate stepped in", f"{hold.n_guarded}"),
        (
            "nearest to the net",
            f"{safety.least_clearance:.2f} m" + (" - CONTACT" if safety.contact else ""),
        ),
        ("share of the time under control", f"{100.0 * steered:.0f} %"),
    ]
    if safety.n_blind:
        late = f"{safety.neutral_late:.2f} s after the last posture, at most"
        figures.append((f"neutral in {safety.n_blind} blind stretches", late))
    if math.isfinite(safety.lost_s):
        figures.append(("LOST", f"the net, for good, at {safety.lost_s:.1f} s"))
    return figures


def _efforts(log: LoopLog, start_s: float) -> list[tuple[str, str]]:
    """Return how often the efforts turned round."""
    names = {"forward": "forward", "right": "right", "turn": "yaw"}
    found = {name: effort_measures(log, column, start_s) for column, name in names.items()}
    reversals = ", ".join(f"{name} {one.reversals:.0f}" for name, one in found.items())
    jumps = ", ".join(f"{name} {one.jumps:.0f}" for name, one in found.items())
    return [
        ("reversals of the effort a minute", reversals),
        (f"jumps of the effort above {JUMP:g} a minute", jumps),
    ]


def summary_lines(log: LoopLog, facts: RunFacts) -> list[str]:
    """Return the summary as lines for a terminal."""
    table = summary(log)
    width = max(len(name) for name, _ in table)
    return [facts.words, *(f"  {name:<{width}}  {value}" for name, value in table)]


def write_report(log: LoopLog, facts: RunFacts, out: Path) -> Path:
    """Draw the figures and write the page beside them; returns the page.

    Raises
    ------
    OutputError
        If something cannot be written.
    """
    with writing(out):
        figures = draw_follow_figures(log, out)
    path = out / PAGE
    with writing(path):
        replace_text(path, _page(log, facts, [figure.name for figure in figures]))
    return path


def _page(log: LoopLog, facts: RunFacts, figures: list[str]) -> str:
    cells = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
        for name, value in summary(log)
    )
    pictures = "".join(
        f'<figure><img src="{name}" alt="{html.escape(_CAPTIONS[name])}">'
        f"<figcaption>{html.escape(_CAPTIONS[name])}</figcaption></figure>"
        for name in figures
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>aqualvs follow</title><style>{_STYLE}</style></head><body>"
        f"<h1>Hold and follow, simulated</h1><p>{html.escape(facts.words)}</p>"
        f"<table>{cells}</table>{pictures}</body></html>\n"
    )


_CAPTIONS = {
    "figure_22.png": "Depth, range, heading and target yaw over time.",
    "figure_23.png": "The controllers on range and yaw: setpoint, measured, true, and the command.",
}
_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;"
    "color:#23272e}table{border-collapse:collapse}th{text-align:left;font-weight:400;"
    "padding-right:2rem}td{font-variant-numeric:tabular-nums}th,td{border-bottom:1px solid #ddd}"
    "figure{margin:2rem 0}img{max-width:100%}figcaption{color:#5a6069}"
)
