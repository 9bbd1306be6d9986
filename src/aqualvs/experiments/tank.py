"""Runs in front of the wall of a tank; the paper's figures 15 to 17.

Figure 15 is the distance to the wall; figures 16 and 17 are pitch and yaw.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    draw_dots,
    drawn,
)
from aqualvs.experiments.laboratory import Laboratory, MeasuredDive, RenderedDive, calibrated_rig
from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.figure_style import DARK, GREY, OURS, PAPER, TRUTH
from aqualvs.simulation.scenario import Scenario, parse_scenario

_ANGLES = {"pitch": (1, 16), "yaw": (2, 17)}
"""Column of the posture, and the paper's figure."""


class _AngleSetup(NamedTuple):
    """Swing in front of the wall, the criterion, and the paper's error."""

    amplitude_deg: float = 20.0
    period_s: float = 4.0
    fps: float = 10.0
    bar_deg: float = 0.5
    paper_percent: int = 14


_SWING = _AngleSetup()


def swing(name: str) -> Scenario:
    """Return the dive: "pitch" or "yaw" swings to both sides in front of a wall at 600 mm."""
    facts = {
        "duration_s": _SWING.period_s,
        "fps": _SWING.fps,
        "motion": {
            f"{name}_deg": {
                "values": [0],
                "sway": _SWING.amplitude_deg,
                "period_s": _SWING.period_s,
            }
        },
        "walls": [{}],
    }
    return parse_scenario(facts, f"angles_{name}", f"angles_{name}")


def _run_angles(laboratory: Laboratory) -> ExperimentResult:
    rig = calibrated_rig(laboratory)
    seen = {name: laboratory.measure(laboratory.dive(swing(name)), rig=rig) for name in _ANGLES}
    worst = {name: seen[name].largest[column] for name, (column, _) in _ANGLES.items()}
    return ExperimentResult(
        sentence=f"Through swings of {_SWING.amplitude_deg:g} degrees to either side pitch stays "
        f"within {worst['pitch']:.2f} and yaw within {worst['yaw']:.2f} degrees of the truth; the "
        f"paper is within {_SWING.paper_percent} % of its compass.",
        findings=tuple(row for name in _ANGLES for row in _findings(name, seen[name])),
        pictures=tuple(
            drawn(
                f"figure_{number}",
                f"{name.capitalize()} while it swings, and its error with two stated "
                f"standard deviations; compare figure {number}. The truth replaces the paper's "
                "compass.",
                3.4,
                partial(_draw_angle, measured=seen[name], name=name),
                "column",
            )
            for name, (_, number) in _ANGLES.items()
        ),
        series=tuple(
            DataColumns(
                name=f"angles_{name}",
                columns={"time_s": seen[name].time_s, **seen[name].columns(column)},
            )
            for name, (column, _) in _ANGLES.items()
        ),
        notes=(
            "A calibration on boards of which only the distances are known, as on the paper's "
            "rail, determines the dome's axes on the vehicle only to some hundredths of a degree; "
            "this is an offset common to all frames.",
        ),
    )


def _findings(name: str, measured: MeasuredDive) -> list[ExperimentRow]:
    column = _ANGLES[name][0]
    worst, errors = float(measured.largest[column]), measured.errors[:, column]
    valid = bool(measured.valid.all())
    return [
        ExperimentRow.at_most(
            f"largest error of {name} (degrees)", worst, _SWING.bar_deg, digits=3, valid=valid
        ),
        ExperimentRow(
            what=f"error of {name} in percent of the swing",
            paper=f"{_SWING.paper_percent}",
            ours=f"{100.0 * worst / _SWING.amplitude_deg:.1f}",
        ),
        ExperimentRow(
            what=f"{name}: root mean square error (degrees)",
            ours=f"{np.sqrt(np.nanmean(errors**2)):.3f}",
        ),
    ]


def _draw_angle(figure: Figure, measured: MeasuredDive, name: str) -> None:
    column = _ANGLES[name][0]
    degrees = np.degrees(np.column_stack([a[:, column] for a in (measured.truth, measured.values)]))
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=(2.0, 1.0))
    top.plot(measured.time_s, degrees[:, 0], color=TRUTH, linewidth=2.2, alpha=0.35)
    top.plot(measured.time_s, degrees[:, 1], ".", color=OURS)
    top.set_ylabel(f"{name} (degrees)")
    top.legend(("truth", "measured"), loc="upper right")
    low.axhline(0.0, color=GREY, linewidth=0.7)
    bars = 2.0 * measured.error_sigmas[:, column]
    draw_dots(low, measured.time_s, measured.errors[:, column], bars, OURS)
    bar = _SWING.bar_deg
    low.set(ylim=(-bar, bar), ylabel="error (degrees)", xlabel="time (s)")
    figure.align_ylabels((top, low))


ANGLES = Experiment(
    title="Pitch and yaw to a wall",
    paper="section 5.3, figures 16 and 17",
    about="At 600 mm in front of a wall first the pitch, then the yaw swings to either side. The "
    "reference is a tilt-compensated compass in the paper, and the ground truth here.",
    run=_run_angles,
)


PLACES_MM = (374, 438, 525, 659)
"""Distances of the vehicle from the wall (paper, section 5.3)."""


class _DistanceSetup(NamedTuple):
    """Frames at each distance, the paper's error, and the criterion."""

    frames: int = 8
    paper_percent: float = 2.3
    bar_percent: float = 0.5


_DISTANCES = _DistanceSetup()


def wall_at_places(places_mm: Sequence[int], frames: int, name: str) -> Scenario:
    """Return the dive: a number of frames at each of some distances, square to a wall."""
    facts = {
        "duration_s": len(places_mm) * frames / 25.0,
        "motion": {
            "range_mm": {"values": list(places_mm), "mode": "steps"},
            # Along the wall, so that the stripes are on different texture in every frame.
            "slide_x_mm": {"values": [0], "sway": 25, "period_s": 0.5},
        },
        "walls": [{}],
    }
    return parse_scenario(facts, name, name)


def wall_dive(laboratory: Laboratory) -> RenderedDive:
    """Return the dive in front of the wall, shared with the ablations."""
    return laboratory.dive(wall_at_places(PLACES_MM, _DISTANCES.frames, "distance"))


def _run_distance(laboratory: Laboratory) -> ExperimentResult:
    dive = wall_dive(laboratory)
    calibrated = laboratory.measure(dive, rig=calibrated_rig(laboratory))
    true = laboratory.measure(dive)
    worst, worst_true = float(calibrated.largest[0]), float(true.largest[0])
    valid = bool(calibrated.valid.all())
    place = np.round(1e3 * calibrated.truth[:, 0])
    spread = max(np.nanstd(calibrated.errors[place == p, 0]) for p in np.unique(place))
    columns = {**calibrated.columns(0), "range_true_rig_m": true.values[:, 0]}
    *most, farthest = PLACES_MM
    return ExperimentResult(
        sentence=f"At {', '.join(map(str, most))} and {farthest} mm every distance is within "
        f"{worst:.3f} % of the truth ({worst_true:.3f} % with the rig known exactly), where the "
        f"paper has {_DISTANCES.paper_percent} %.",
        findings=(
            ExperimentRow.at_most(
                "largest error of the distance, rig calibrated from pictures (%)",
                worst,
                _DISTANCES.bar_percent,
                digits=3,
                paper=f"{_DISTANCES.paper_percent}",
                valid=valid,
            ),
            ExperimentRow(
                what="largest error of the distance, true rig (%)", ours=f"{worst_true:.3f}"
            ),
            ExperimentRow(what="spread between frames at one distance (%)", ours=f"{spread:.4f}"),
            ExperimentRow(
                what="frames with a posture",
                ours=f"{np.count_nonzero(calibrated.valid)} of {len(calibrated.scans)}",
            ),
        ),
        pictures=(
            drawn(
                "figure_15",
                "Error of the distance at the paper's four distances, at the paper's scale (left) "
                "and at ours (right); compare figure 15. Every dot is a frame, bars are two stated "
                "standard deviations.",
                2.7,
                lambda figure: _draw_distance(figure, calibrated, true),
            ),
        ),
        series=(DataColumns(name="distance", columns=columns),),
        notes=(
            "The reference is the simulator's ground truth; the paper's distances were set by "
            "hand.",
            "The error of calibration is common to all frames at a distance; the bars are noise "
            "only.",
        ),
    )


def _draw_distance(figure: Figure, calibrated: MeasuredDive, true: MeasuredDive) -> None:
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
    left.axhspan(
        -_DISTANCES.paper_percent, _DISTANCES.paper_percent, color=PAPER, alpha=0.15, linewidth=0
    )
    left.text(370, 1.95, f"paper: within {_DISTANCES.paper_percent} %", color=PAPER, va="top")
    left.plot(1e3 * calibrated.truth[:, 0], calibrated.errors[:, 0], ".", color=OURS)
    left.set_ylim(-2.6, 2.6)
    left.set_title("at the paper's scale", loc="left")
    _dots(right, true, GREY, "true rig", -4.0)
    _dots(right, calibrated, OURS, "calibrated rig", 4.0)
    right.set_title("at ours", loc="left")
    right.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    for axes in (left, right):
        axes.axhline(0.0, color=DARK, linewidth=0.7)
        axes.set(xticks=PLACES_MM, xlim=(345, 688), xlabel="true distance (mm)")
    left.set_ylabel("error of the distance (%)")


def _dots(axes: Axes, measured: MeasuredDive, colour: str, label: str, aside_mm: float) -> None:
    """Draw the frames at a distance side by side, so that they can be distinguished."""
    at = 1e3 * measured.truth[:, 0] + aside_mm + _fanned(measured.truth[:, 0])
    errors, bars = measured.errors[:, 0], 2.0 * measured.error_sigmas[:, 0]
    draw_dots(axes, at, errors, bars, colour, bar_width=0.5, label=label)


def _fanned(truth: FloatArray) -> FloatArray:
    """Return a small shift in mm for each frame among those at its distance."""
    place = np.round(1e3 * truth)
    shift = np.zeros(len(truth))
    for p in np.unique(place):
        rows = np.flatnonzero(place == p)
        shift[rows] = np.linspace(-3.0, 3.0, len(rows))
    return shift


DISTANCE = Experiment(
    title="Distance to a wall",
    paper="section 5.3, figure 15",
    about="The vehicle stands square to the wall of a tank, at four distances. A rig calibrated "
    "from pictures only measures them; the ground truth is known.",
    run=_run_distance,
)
