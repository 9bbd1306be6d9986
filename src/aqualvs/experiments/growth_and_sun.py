"""Growth on the net and sunlight, on which the paper's system failed (figure 24).

The visible stripe points of each frame are counted by rendering the dive again, to know the frames
in which a posture can be required.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    draw_dots,
    drawn,
    listed,
)
from aqualvs.experiments.laboratory import Laboratory, MeasuredDive, RenderedDive, frames_of
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.report.figure_style import BLUE, GREEN, ORANGE
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.posture_estimator import FitMethod
from aqualvs.scanning.stripe import ThresholdOptions
from aqualvs.simulation.benchmark import CONTRAST_LIMIT, VISIBLE_LIMIT, render_with_visible
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import Scenario, parse_scenario
from aqualvs.sources.base import bgr_of

_FILE = "visible.csv"


def visible_points(laboratory: Laboratory, dive: RenderedDive) -> FloatArray:
    """Return the number of visible stripe points on the target, for each frame.

    `aqualvs.simulation.benchmark` defines when a point is visible. The frames are rendered again
    for this, with progress to `laboratory`; the numbers are kept beside the dive.
    """
    path = dive.folder / _FILE
    if not path.exists():
        scenario = dive.scenario
        renderer = Renderer(dive.rig, threads=os.cpu_count() or 1)
        counts = []
        for i, t in enumerate(scenario.times()):
            rng = np.random.default_rng([scenario.seed, i])
            counts.append(len(render_with_visible(renderer, scenario.scene_at, t, rng)[1]))
            laboratory.rendered(i + 1, scenario.n_frames)
        path.write_text("".join(f"{count}\n" for count in counts), encoding="utf-8")
    return np.loadtxt(path, ndmin=1)


PAPERS_WAY = ScannerOptions(
    detector=ThresholdOptions(), mesh_filter=MeshFilterOptions(), fit=FitMethod.PSEUDO_INVERSE
)
"""The paper's method: threshold, mesh filter with the parameters of section 5.2, pseudo-inverse."""

_MOTION: Mapping[str, Any] = {
    "range_mm": {"values": [450, 620, 520], "sway": 4, "period_s": 0.7},
    "pitch_deg": [5, -4],
    "yaw_deg": [-8, 10],
    "slide_x_mm": [0, 120],
}
_NET: Mapping[str, Any] = {"bar_mm": 25, "twine_mm": 2}
_SCENES: Mapping[str, Mapping[str, Any]] = {
    "clear": {"net": dict(_NET)},
    "growth": {
        "net": {**_NET, "fouling": 0.6, "growth": 2.5},
        "water": {
            "attenuation_per_m": [1.2, 0.55, 0.75],
            "veil": [0.06, 0.13, 0.09],
            "sheet_scatter_per_m": 0.7,
            "snow": 700,
        },
    },
    "sun": {
        "net": dict(_NET),
        "water": {"caustics": 0.65, "glare": 0.5, "ambient": [0.50, 0.82, 0.78]},
    },
}
_COLOURS = {"clear": BLUE, "growth": GREEN, "sun": ORANGE}
# Duration of a dive, and the frame that the figure shows.
_SECONDS, _SHOWN = 0.8, 10
# Largest errors in the clear scene: range in percent, pitch and yaw in degrees; twice that in the
# others.
_CLEAR_LIMITS = (0.5, 0.5, 0.5)


@dataclass(frozen=True, slots=True)
class MeasuredScene:
    """Scene: its dive, measured by our and by the paper's method, and the visible points."""

    dive: RenderedDive
    ours: MeasuredDive
    papers: MeasuredDive
    visible: FloatArray

    @property
    def asked(self) -> BoolArray:
        """Mask (N,) of frames with enough visible points, in which a posture is required."""
        return np.asarray(self.visible >= VISIBLE_LIMIT)

    def valid_percent(self, measured: MeasuredDive) -> float:
        """Return the share of those frames that have a posture."""
        return 100.0 * float(np.mean(measured.valid[self.asked])) if self.asked.any() else np.nan


def scene(name: str) -> Scenario:
    """Return the dive before a "clear" net, one with "growth" in turbid water, or in the "sun"."""
    facts = {"duration_s": _SECONDS, "motion": dict(_MOTION), **_SCENES[name]}
    return parse_scenario(facts, f"failures_{name}", f"failures_{name}")


def _run(laboratory: Laboratory) -> ExperimentResult:
    seen = {}
    for name in _SCENES:
        dive = laboratory.dive(scene(name))
        ours, papers_way = laboratory.measure(dive), laboratory.measure(dive, PAPERS_WAY)
        seen[name] = MeasuredScene(dive, ours, papers_way, visible_points(laboratory, dive))
    valid = {name: one.valid_percent(one.ours) for name, one in seen.items()}
    papers = {name: one.valid_percent(one.papers) for name, one in seen.items()}
    return ExperimentResult(
        sentence=f"With growth on 60 % of the net {valid['growth']:.0f} %, in sunlight "
        f"{valid['sun']:.0f} % of the frames have a posture, where the paper's filter gives "
        f"{papers['growth']:.0f} and {papers['sun']:.0f} %; range within "
        f"{seen['growth'].ours.rms[0]:.2f} and {seen['sun'].ours.rms[0]:.2f} % root mean square.",
        findings=tuple(row for name in _SCENES for row in _findings(name, seen)),
        pictures=(
            drawn(
                "figure_24",
                "A frame of each scene and the errors of every frame, with two stated standard "
                "deviations; compare figure 24.",
                5.6,
                lambda figure: _draw(figure, seen),
            ),
        ),
        series=tuple(_series(name, one) for name, one in seen.items()),
        notes=(
            f"Counted are frames in which {VISIBLE_LIMIT} stripe points or more of the net stand "
            f"out by {CONTRAST_LIMIT:g} grey levels in the picture before noise and coding.",
            "Errors are relative to the plane through the lit points: growth stands out from the "
            "net, and the lasers measure to it.",
        ),
    )


def _findings(name: str, seen: Mapping[str, MeasuredScene]) -> list[ExperimentRow]:
    one, judged = seen[name], name != "clear"
    valid, rms, largest = one.valid_percent(one.ours), one.ours.rms, one.ours.largest
    limits = np.array(_CLEAR_LIMITS) * (2.0 if judged else 1.0)
    bar_valid = 90.0
    return [
        ExperimentRow(
            what=f"{name}: frames with a posture (%)",
            paper="not applicable" if judged else "",
            ours=f"{valid:.0f} (of {int(one.asked.sum())}; the paper's way "
            f"{one.valid_percent(one.papers):.0f})",
            bar=f">= {bar_valid:g}" if judged else "",
            met=valid >= bar_valid if judged else None,
        ),
        ExperimentRow(
            what=f"{name}: largest error of range (%), pitch, yaw (degrees)",
            ours=listed(largest, 3),
            bar="<= " + ", ".join(f"{limit:g}" for limit in limits),
            met=bool(np.all(largest <= limits)),
        ),
        ExperimentRow(
            what=f"{name}: root mean square error, and as many times the clear scene's",
            ours=listed(rms, 3)
            + (f"; {listed(rms / seen['clear'].ours.rms, 1)}" if judged else ""),
        ),
        ExperimentRow(
            what=f"{name}: stated sigma (median)",
            ours=listed(np.nanmedian(one.ours.error_sigmas, axis=0), 3),
        ),
    ]


def _series(name: str, one: MeasuredScene) -> DataColumns:
    columns = {"time_s": one.ours.time_s, "visible_points": one.visible}
    for k in range(3):
        columns |= one.ours.columns(k)
    return DataColumns(name=f"failures_{name}", columns=columns)


def _draw(figure: Figure, seen: Mapping[str, MeasuredScene]) -> None:
    grid = figure.subplots(3, 3, height_ratios=(1.6, 1.0, 1.0), sharey="row")
    for column, (name, one) in enumerate(seen.items()):
        picture, *errors = grid[:, column]
        colours = bgr_of(frames_of(one.dive)[_SHOWN])[..., ::-1]
        picture.imshow(colours, interpolation="nearest")
        picture.set_title(name, loc="left")
        picture.set_axis_off()
        values, bars = one.ours.errors, 2.0 * one.ours.error_sigmas
        for axes, k in zip(errors, (0, 2), strict=True):
            axes.axhline(0.0, color="#8a8f98", linewidth=0.7)
            draw_dots(axes, one.ours.time_s, values[:, k], bars[:, k], _COLOURS[name])
        errors[-1].set_xlabel("time (s)")
    grid[1, 0].set_ylabel("range error (%)")
    grid[2, 0].set_ylabel("yaw error (degrees)")
    figure.align_ylabels(grid[1:, 0])


EXPERIMENT = Experiment(
    title="Growth and sunlight",
    paper="section 5.5, figure 24",
    about="The same course along a clear net, a net with growth on most of it in turbid water, and "
    "a net close below the surface in the sun: the two cases in which the paper's system "
    "failed.",
    run=_run,
)
