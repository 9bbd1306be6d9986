"""Distance and yaw under control before a net, where the paper has figure 23."""

import math

import numpy as np

from aqualvs.app.follow_figures import drawn_follow_figures
from aqualvs.app.follow_sim_case import vehicle_model
from aqualvs.app.follow_sim_log import LoopLog
from aqualvs.app.follow_sim_measures import HoldMeasures, StepMeasures
from aqualvs.app.follow_trials import Trials
from aqualvs.app.reproduce.experiment import Experiment, Finding, Outcome, Picture, Series
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.control.gains_file import load_gains

_VEHICLES = {"bluerov2": "BlueROV2", "bluerov2-heavy": "BlueROV2 Heavy"}
_SEED = 1
_BAR_RANGE_MM, _BAR_YAW_DEG, _BAR_SETTLING_S, _BAR_OVERSHOOT = 15.0, 1.5, 4.0, 0.15
_BAR_FOLLOW_MM, _BAR_FOLLOW_DEG = 30.0, 3.0
_COLUMNS = ("range", "measured_range", "wanted_range", "forward")
_ANGLES = ("yaw", "measured_yaw", "wanted_yaw")


def _run(laboratory: Laboratory) -> Outcome:  # noqa: ARG001
    held = {name: _trials(name).hold_and_step() for name in _VEHICLES}
    followed = {name: _trials(name).follow() for name in _VEHICLES}
    worst = max(1e3 * hold.range_rms for _, hold, _ in held.values())
    yaw = max(math.degrees(hold.yaw_rms) for _, hold, _ in held.values())
    return Outcome(
        sentence=f"In a current of 0.3 m/s and waves both BlueROV2 keep their distance within "
        f"{worst:.0f} mm and their yaw within {yaw:.1f} degrees (rms).",
        findings=tuple(
            row
            for name in _VEHICLES
            for row in (
                *_hold_rows(_VEHICLES[name], *held[name][1:]),
                *_follow_rows(_VEHICLES[name], *followed[name]),
            )
        ),
        pictures=(
            Picture(
                name="figure_23",
                caption="Setpoint, measurement and command of both controllers (BlueROV2): hold, "
                "then a step of the range, beside figure 23.",
                figure=drawn_follow_figures(held["bluerov2"][0])["figure_23"],
            ),
        ),
        series=tuple(_series(name, log) for name, (log, _, _) in held.items()),
        notes=(
            "Simulated vehicles (Fossen's model with the published parameters of both) with the "
            "packaged gains, steered by postures with sampled noise and a delay of 60 ms. "
            "`aqualvs follow --sim --rendered` closes the loop through rendered pictures.",
            "The paper prints curves without figures for this experiment.",
        ),
    )


def _trials(name: str) -> Trials:
    model = vehicle_model(name)
    return Trials(model, load_gains(model.name), rendered=False, fps=25.0, seed=_SEED)


def _hold_rows(vehicle: str, hold: HoldMeasures, step: StepMeasures) -> tuple[Finding, ...]:
    range_mm, yaw_deg = 1e3 * hold.range_rms, math.degrees(hold.yaw_rms)
    return (
        Finding(
            what=f"{vehicle}, hold: rms of range (mm), yaw (degrees)",
            paper="",
            ours=f"{range_mm:.1f}, {yaw_deg:.2f}",
            bar=f"<= {_BAR_RANGE_MM:g}, {_BAR_YAW_DEG:g}",
            met=range_mm <= _BAR_RANGE_MM and yaw_deg <= _BAR_YAW_DEG,
        ),
        Finding(
            what=f"{vehicle}, step of 0.2 m: settling (s), overshoot (%)",
            paper="",
            ours=f"{step.settling:.1f}, {100.0 * step.overshoot:.0f}",
            bar=f"<= {_BAR_SETTLING_S:g}, {100.0 * _BAR_OVERSHOOT:g}",
            met=step.settling <= _BAR_SETTLING_S and step.overshoot <= _BAR_OVERSHOOT,
        ),
    )


def _follow_rows(vehicle: str, log: LoopLog, follow: HoldMeasures) -> tuple[Finding, ...]:
    range_mm, yaw_deg = 1e3 * follow.range_rms, math.degrees(follow.yaw_rms)
    free = follow.least_clearance > 0.0 and follow.n_lost == 0
    along = log.column("along")
    return (
        Finding(
            what=f"{vehicle}, following a curved, moving net over {along[-1] - along[0]:.0f} m: "
            "rms of range (mm), yaw (degrees)",
            paper="",
            ours=f"{range_mm:.1f}, {yaw_deg:.2f}" + ("" if free else "; touched or lost the net"),
            bar=f"<= {_BAR_FOLLOW_MM:g}, {_BAR_FOLLOW_DEG:g}",
            met=free and range_mm <= _BAR_FOLLOW_MM and yaw_deg <= _BAR_FOLLOW_DEG,
        ),
    )


def _series(name: str, log: LoopLog) -> Series:
    columns = {"time_s": log.column("time_s")}
    for column in _COLUMNS:
        columns[column if column == "forward" else f"{column}_m"] = log.column(column)
    for column in _ANGLES:
        columns[f"{column}_deg"] = np.degrees(log.column(column))
    columns["turn"] = log.column("turn")
    return Series(name=f"control_{name.replace('-', '_')}", columns=columns)


EXPERIMENT = Experiment(
    name="control",
    title="Distance and yaw under control",
    paper="section 5.5, figure 23",
    about="The vehicle holds 0.6 m and stays square to a net in a current of 0.3 m/s and waves, "
    "then goes 0.2 m back; after that it follows a curved, moving net for a minute.",
    run=_run,
)
