"""Controlled runs along a net; the paper's figures 22 and 23.

Figure 22 is a descent along a net at sea with distance and heading held; figure 23 shows distance
and yaw control in front of a net.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import Guidance, Mission, Stage
from aqualvs.control.vehicle import Setpoint, VehicleState
from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentFigure,
    ExperimentResult,
    ExperimentRow,
    drawn,
)
from aqualvs.experiments.laboratory import Laboratory
from aqualvs.follow.case import SimCase, Trials, sea, vehicle_model
from aqualvs.follow.log import HoldMeasures, LoopLog, StepMeasures
from aqualvs.follow.report import drawn_follow_figures
from aqualvs.follow.sensor_model import RenderedSensor, SampledSensor
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.report.figure_style import BLUE, DARK, GREY, ORANGE
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.simulation.net_motion import NetPosture, NetWall
from aqualvs.simulation.scene import Net, Scene

_VEHICLES = {"bluerov2": "BlueROV2", "bluerov2-heavy": "BlueROV2 Heavy"}
_COLUMNS = ("range", "measured_range", "wanted_range", "forward")
_ANGLES = ("yaw", "measured_yaw", "wanted_yaw")


def _run_control(laboratory: Laboratory) -> ExperimentResult:  # noqa: ARG001
    held = {name: _trials(name).hold_and_step() for name in _VEHICLES}
    followed = {name: _trials(name).follow() for name in _VEHICLES}
    worst = max(1e3 * hold.range_rms for _, hold, _ in held.values())
    yaw = max(math.degrees(hold.yaw_rms) for _, hold, _ in held.values())
    return ExperimentResult(
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
            ExperimentFigure(
                name="figure_23",
                caption="Setpoint, measurement and command of both controllers (BlueROV2): hold, "
                "then a step of the range; compare figure 23.",
                figure=drawn_follow_figures(held["bluerov2"][0])["figure_23"],
            ),
        ),
        series=tuple(_series(name, log) for name, (log, _, _) in held.items()),
        notes=(
            "Simulated vehicles (Fossen's model with the published parameters of both) with the "
            "packaged gains, controlled with postures with sampled noise and a delay of 60 ms. "
            "`aqualvs follow --sim --rendered` closes the loop through rendered pictures.",
            "The paper shows curves without numbers for this experiment.",
        ),
    )


def _trials(name: str) -> Trials:
    model = vehicle_model(name)
    return Trials(model, load_gains(model.name), seed=1)


def _hold_rows(vehicle: str, hold: HoldMeasures, step: StepMeasures) -> tuple[ExperimentRow, ...]:
    range_mm, yaw_deg = 1e3 * hold.range_rms, math.degrees(hold.yaw_rms)
    bar_range_mm, bar_yaw_deg, bar_settling_s, bar_overshoot = 15.0, 1.5, 4.0, 0.15
    return (
        ExperimentRow(
            what=f"{vehicle}, hold: rms of range (mm), yaw (degrees)",
            ours=f"{range_mm:.1f}, {yaw_deg:.2f}",
            bar=f"<= {bar_range_mm:g}, {bar_yaw_deg:g}",
            met=range_mm <= bar_range_mm and yaw_deg <= bar_yaw_deg,
        ),
        ExperimentRow(
            what=f"{vehicle}, step of 0.2 m: settling (s), overshoot (%)",
            ours=f"{step.settling:.1f}, {100.0 * step.overshoot:.0f}",
            bar=f"<= {bar_settling_s:g}, {100.0 * bar_overshoot:g}",
            met=step.settling <= bar_settling_s and step.overshoot <= bar_overshoot,
        ),
    )


def _follow_rows(vehicle: str, log: LoopLog, follow: HoldMeasures) -> tuple[ExperimentRow, ...]:
    range_mm, yaw_deg = 1e3 * follow.range_rms, math.degrees(follow.yaw_rms)
    free = follow.min_clearance > 0.0 and follow.n_lost == 0
    along = log.column("along")
    bar_follow_mm, bar_follow_deg = 30.0, 3.0
    return (
        ExperimentRow(
            what=f"{vehicle}, following a curved, moving net over {along[-1] - along[0]:.0f} m: "
            "rms of range (mm), yaw (degrees)",
            ours=f"{range_mm:.1f}, {yaw_deg:.2f}" + ("" if free else "; touched or lost the net"),
            bar=f"<= {bar_follow_mm:g}, {bar_follow_deg:g}",
            met=free and range_mm <= bar_follow_mm and yaw_deg <= bar_follow_deg,
        ),
    )


def _series(name: str, log: LoopLog) -> DataColumns:
    columns = {"time_s": log.column("time_s")}
    for column in _COLUMNS:
        columns[column if column == "forward" else f"{column}_m"] = log.column(column)
    for column in _ANGLES:
        columns[f"{column}_deg"] = np.degrees(log.column(column))
    columns["turn"] = log.column("turn")
    return DataColumns(name=f"control_{name.replace('-', '_')}", columns=columns)


CONTROL = Experiment(
    title="Distance and yaw under control",
    paper="section 5.5, figure 23",
    about="The vehicle holds 0.6 m and stays square to a net in a current of 0.3 m/s and waves, "
    "then moves back 0.2 m; after that it follows a curved, moving net for a minute.",
    run=_run_control,
)


class _Setup(NamedTuple):
    """Descent along the net in m and m/s, and the criteria."""

    seconds: float = 40.0
    # Frames from one rendered picture to the next.
    every: int = 10
    range: float = 0.6
    descent: float = 0.08
    bar_percent: float = 0.5
    bar_deg: float = 0.5
    bar_valid: float = 90.0


_SETUP = _Setup()


class _Descent(Mission):
    """Mission that sinks at a constant speed and holds range and yaw."""

    sways = False

    def update(
        self,
        now_s: float,  # noqa: ARG002
        posture: Posture | None,
        state: VehicleState,  # noqa: ARG002
    ) -> Guidance:
        """Return the setpoint and the descent; wait without a posture."""
        if posture is None:
            return Guidance(setpoint=None, stage=Stage.WAITING)
        return Guidance(setpoint=self.setpoint, down=_SETUP.descent, stage=Stage.CHANGING_DEPTH)


@dataclass(slots=True)
class _PartlyRendered:
    """Sensor for control with sampled postures, which renders and scans every tenth picture.

    Rendering a picture takes longer than the rest of a simulated second. `seen` collects the
    results of the scanner, with the truth; they do not affect the control.
    """

    net: NetWall
    steering: SampledSensor
    rendered: RenderedSensor
    laboratory: Laboratory
    n_looks: int = 0
    seen: list[tuple[float, Posture | Refusal, NetPosture]] = field(default_factory=list)

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal | None:
        """Return the sampled posture."""
        if self.n_looks % _SETUP.every == 0:
            posture = self.rendered.look(world_from_dome, time_s)
            truth = self.net.posture_at(world_from_dome, time_s)
            self.seen.append((time_s, posture, truth))
            self.laboratory.rendered(0, 0)
        self.n_looks += 1
        return self.steering.look(world_from_dome, time_s)


def _run_sea(laboratory: Laboratory) -> ExperimentResult:
    sensor, log = _dive(laboratory)
    time_s = np.array([t for t, _, _ in sensor.seen])
    measured, truth = _postures(sensor)
    valid = np.isfinite(measured[:, 0])
    errors = (measured - truth)[valid]
    errors[:, 0] *= 100.0 / truth[valid, 0]
    rms = np.sqrt(np.mean(errors**2, axis=0))
    share = 100.0 * float(valid.mean())
    depth, heading = log.column("depth"), np.unwrap(log.column("heading"))
    return ExperimentResult(
        sentence=f"Sinking from {depth[0]:.1f} to {depth[-1]:.1f} m along a net that moves, range "
        f"is measured within {rms[0]:.2f} % and yaw within {rms[2]:.2f} degrees (rms) in "
        f"{share:.0f} % of the pictures.",
        findings=(
            ExperimentRow(
                what="pictures with a posture (%)",
                ours=f"{share:.0f} of {len(valid)}",
                bar=f">= {_SETUP.bar_valid:g}",
                met=share >= _SETUP.bar_valid,
            ),
            ExperimentRow.at_most(
                "rms error of the range (%)", rms[0], _SETUP.bar_percent, digits=3
            ),
            ExperimentRow(
                what="rms error of pitch, yaw (degrees)",
                ours=f"{rms[1]:.3f}, {rms[2]:.3f}",
                bar=f"<= {_SETUP.bar_deg}",
                met=bool(rms[1:].max() <= _SETUP.bar_deg),
            ),
            ExperimentRow(
                what="correlation of heading and target yaw",
                paper="some",
                ours=f"{np.corrcoef(heading, log.column('yaw'))[0, 1]:+.2f}",
            ),
        ),
        pictures=(
            drawn(
                "figure_22",
                "Depth, range, heading and yaw of the net over the dive; compare figure 22. Dots: "
                "measured in rendered pictures; lines: truth.",
                5.0,
                lambda figure: _draw(figure, log, time_s, measured),
            ),
        ),
        series=(_sea_series(time_s, measured, truth),),
        notes=(
            "A simulated BlueROV2 in a current of 0.15 m/s and waves of 0.1 m in front of the net "
            "of a cage of 20 m radius that sways and rocks. It is controlled with postures with "
            "sampled noise at 25 Hz, and every tenth picture is rendered and measured; `aqualvs "
            "follow --sim --rendered` renders all of them.",
            "A vehicle that turns to the right sees a net that turns to the left: heading and yaw "
            "have opposite signs here, where yaw is positive to the right. Motion of the net "
            "itself weakens this correlation, at sea and in the simulation.",
            "Range and angles are relative to the tangent plane of the net at the nearest point, a "
            "twine's radius behind the light.",
        ),
    )


def _dive(laboratory: Laboratory) -> tuple[_PartlyRendered, LoopLog]:
    """Simulate the descent; return the sensor with its scans, and the log."""
    net = NetWall(curvature=-1.0 / 20.0, sway=0.04, sway_period=9.0, rock=math.radians(3.0))
    model = vehicle_model("bluerov2")
    sea_seed = 22
    case = SimCase(
        model=model,
        gains=load_gains(model.name),
        water=sea(current=0.15, waves=0.1, seed=sea_seed),
        net=net,
        start_range=_SETUP.range,
        seed=sea_seed,
    )
    scene = Scene(
        dome_from_scene=SE3.identity(),
        nets=(Net(bar=0.025, twine=0.0022, fouling=0.2, seed=sea_seed),),
        target="net",
    )
    sensor = _PartlyRendered(
        net,
        SampledSensor(net, np.random.default_rng([sea_seed, 1])),
        RenderedSensor(net, laboratory.rig, np.random.default_rng([sea_seed, 2]), scene),
        laboratory,
    )
    loop = case.loop(sensor, _Descent(Setpoint(_SETUP.range)))
    return sensor, loop.run(_SETUP.seconds)


def _postures(sensor: _PartlyRendered) -> tuple[FloatArray, FloatArray]:
    """Return the measured postures, NaN for refusals, and the true ones; shape (N, 3) each.

    Range in metres, pitch and yaw in degrees.
    """
    found = [
        (one.range, one.pitch, one.yaw) if isinstance(one, Posture) else (math.nan,) * 3
        for _, one, _ in sensor.seen
    ]
    true = [truth[:3] for _, _, truth in sensor.seen]
    scale = np.array([1.0, 180.0 / math.pi, 180.0 / math.pi])
    return scale * np.array(found), scale * np.array(true)


def _sea_series(time_s: FloatArray, measured: FloatArray, truth: FloatArray) -> DataColumns:
    columns = {"time_s": time_s}
    for k, name in enumerate(("range_m", "pitch_deg", "yaw_deg")):
        columns |= {f"true_{name}": truth[:, k], name: measured[:, k]}
    return DataColumns(name="sea", columns=columns)


def _draw(figure: Figure, log: LoopLog, seen_s: FloatArray, measured: FloatArray) -> None:
    time_s = log.column("time_s")
    depth, ranges, angles = figure.subplots(3, 1, sharex=True)
    depth.plot(time_s, log.column("depth"), color=BLUE)
    depth.invert_yaxis()
    depth.set_ylabel("depth (m)")
    ranges.plot(time_s, log.column("range"), color=DARK, alpha=0.5, label="true")
    ranges.plot(seen_s, measured[:, 0], ".", color=BLUE, label="measured")
    ranges.set_ylabel("range (m)")
    ranges.legend(loc="upper right", ncols=2)
    heading = np.degrees(np.unwrap(log.column("heading")))
    angles.plot(time_s, heading - heading[0], color=ORANGE, label="heading, from its start")
    angles.plot(time_s, np.degrees(log.column("yaw")), color=DARK, alpha=0.5, label="true yaw")
    angles.plot(seen_s, measured[:, 2], ".", color=BLUE, label="measured yaw")
    angles.axhline(0.0, color=GREY, linewidth=0.6)
    angles.set(ylabel="angle (degrees)", xlabel="time (s)")
    angles.legend(loc="upper right", ncols=3)
    for axes in (ranges, angles):
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))
    figure.align_ylabels((depth, ranges, angles))


SEA = Experiment(
    title="Down along a net at sea",
    paper="section 5.5, figure 22",
    about="The vehicle sinks along the net of a cage in current and waves, keeping its distance; "
    "the net sways and rocks. Depth and heading come from the vehicle's own sensors.",
    run=_run_sea,
)
