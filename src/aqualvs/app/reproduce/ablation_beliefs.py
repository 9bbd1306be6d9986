"""What a wrong refractive index and a wrong place of the lens cost."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.app.reproduce.distance import wall_dive
from aqualvs.app.reproduce.experiment import Experiment, Finding, Outcome, Picture, Series
from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.app.reproduce.style import BLUE, GREEN, GREY, ORANGE, STYLE, new_figure
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INDEX_STEPS = (-0.010, -0.005, 0.0, 0.005, 0.010)
# Beyond this the stripes of this strongly decentred lens no longer share a plane.
_LENS_STEPS_MM = (-0.5, -0.25, 0.0, 0.25, 0.5)
_AXES = ("right", "forward", "up")
_COLOURS = (ORANGE, BLUE, GREEN)
_WATERS = 0.007
"""From fresh to sea water (S = 35): what one who never measures the index may be off by."""


def _run(laboratory: Laboratory) -> Outcome:
    dive = wall_dive(laboratory)
    index = np.array([_worst(laboratory, dive, _with_index(dive.rig, d)) for d in _INDEX_STEPS])
    lens = np.array(
        [
            [_worst(laboratory, dive, _with_lens(dive.rig, axis, mm)) for mm in _LENS_STEPS_MM]
            for axis in range(3)
        ]
    )
    per_index = _slope(_INDEX_STEPS, index) * _WATERS
    per_mm = np.array([_slope(_LENS_STEPS_MM, row) for row in lens])
    return Outcome(
        sentence=f"Sea water taken for fresh costs {per_index:.2f} % of the range through this "
        f"dome; a lens believed 1 mm from its place costs up to {per_mm.max():.1f} %.",
        findings=(
            Finding(
                what=f"range error for an index wrong by {_WATERS} (%)",
                paper="",
                ours=f"{per_index:.2f}",
            ),
            *(
                Finding(
                    what=f"range error for each mm that the lens is believed too far {name} (%)",
                    paper="",
                    ours=f"{cost:.2f}",
                )
                for name, cost in zip(_AXES, per_mm, strict=True)
            ),
        ),
        pictures=(
            Picture(
                name="ablation_beliefs",
                caption="Largest range error before the wall at the paper's four distances when "
                "the scanner believes another index of the water (left) or another place of the "
                "lens in the dome (right).",
                figure=_drawn(index, lens),
            ),
        ),
        series=(
            Series(
                name="ablation_index",
                columns={"index_error": np.array(_INDEX_STEPS), "range_error_percent": index},
            ),
            Series(
                name="ablation_lens",
                columns={
                    "lens_error_mm": np.array(_LENS_STEPS_MM),
                    **{
                        f"{name}_range_error_percent": row
                        for name, row in zip(_AXES, lens, strict=True)
                    },
                },
            ),
        ),
        notes=(
            "The laser planes stay those of the true rig. Lasers that were calibrated with the "
            "wrong belief would take up a part of the error near the places of calibration.",
            "Where a point is missing, the lasers' points no longer shared a plane: the posture "
            "was refused.",
        ),
    )


def _with_index(rig: Rig, step: float) -> Rig:
    return rig.in_water(rig.n_water + step)


def _with_lens(rig: Rig, axis: int, step_mm: float) -> Rig:
    place = rig.dome_from_cam.translation.copy()
    place[axis] += 1e-3 * step_mm
    return replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, place))


def _worst(laboratory: Laboratory, dive: Dive, rig: Rig) -> float:
    """Return the range error of the place where it is largest, in percent, with its sign."""
    percent = laboratory.measure(dive, rig=rig).range_percent
    found = percent[np.isfinite(percent)]
    return float(found[np.argmax(np.abs(found))]) if len(found) else np.nan


def _slope(steps: Sequence[float], percent: FloatArray) -> float:
    """Return the cost per step; where no plane was found any more there is none to be told."""
    told = np.isfinite(percent)
    return float(abs(np.polyfit(np.array(steps)[told], percent[told], 1)[0]))


def _drawn(index: FloatArray, lens: FloatArray) -> "Figure":
    from matplotlib import rc_context

    with rc_context(dict(STYLE)):
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2)
        left.plot(_INDEX_STEPS, index, ".-", color=BLUE)
        left.set_xlabel("error of the index believed")
        left.set_ylabel("error of the range (%)")
        for row, name, colour in zip(lens, _AXES, _COLOURS, strict=True):
            right.plot(_LENS_STEPS_MM, row, ".-", color=colour, label=name)
        right.set_xlabel("error of the lens's place believed (mm)")
        right.legend(loc="best")
        for axes in (left, right):
            axes.axhline(0.0, color=GREY, linewidth=0.7)
    return figure


EXPERIMENT = Experiment(
    name="beliefs",
    title="What wrong beliefs cost",
    paper="",
    about="The wall at the paper's four distances, measured with the true rig but for one "
    "parameter: the index of the water, or the place of the lens in the dome.",
    run=_run,
)
