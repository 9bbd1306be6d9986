"""Down along a net at sea, distance and heading kept, where the paper has figure 22."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.app.follow_fast_eye import SampledEye
from aqualvs.app.follow_rendered import RenderedEye
from aqualvs.app.follow_sim_case import SimCase, sea, vehicle_model
from aqualvs.app.follow_sim_log import LoopLog
from aqualvs.app.reproduce.experiment import Experiment, Finding, Outcome, Picture, Series
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.app.reproduce.style import BLUE, DARK, GREY, ORANGE, STYLE, new_figure
from aqualvs.control.gains_file import load_gains
from aqualvs.control.mission import Guidance, Stage
from aqualvs.control.setpoint import Setpoint
from aqualvs.control.vehicle import VehicleState
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.simulation.net_motion import NetPosture, NetWall
from aqualvs.simulation.scene import Net, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SECONDS, _EVERY = 40.0, 10
_RANGE, _DESCENT = 0.6, 0.08
_SEED = 22
_BAR_PERCENT, _BAR_DEG, _BAR_VALID = 0.5, 0.5, 90.0


class _Descent:
    """A mission: sink at a constant speed, holding range and yaw."""

    sways = False

    def __init__(self, setpoint: Setpoint) -> None:
        self._setpoint = setpoint

    def update(
        self,
        now_s: float,  # noqa: ARG002
        posture: Posture | None,
        state: VehicleState,  # noqa: ARG002
    ) -> Guidance:
        """Return range, yaw and descent; nothing without the net."""
        if posture is None:
            return Guidance(setpoint=None, stage=Stage.WAITING)
        return Guidance(setpoint=self._setpoint, down=_DESCENT, stage=Stage.CHANGING_DEPTH)

    def restart(self) -> None:
        """Nothing is kept."""


@dataclass(slots=True)
class _Watched:
    """Steers by sampled postures, and looks at rendered pictures now and then.

    A picture takes longer to render than all the rest of a second together; what the scanner makes
    of every tenth of them is written down.
    """

    net: NetWall
    steering: SampledEye
    rendered: RenderedEye
    laboratory: Laboratory
    n_looks: int = 0
    seen: list[tuple[float, Posture | Refusal, NetPosture]] = field(default_factory=list)

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal | None:
        """Return the sampled posture."""
        if self.n_looks % _EVERY == 0:
            posture = self.rendered.look(world_from_dome, time_s)
            truth = self.net.posture_at(world_from_dome, time_s)
            self.seen.append((time_s, posture, truth))
            self.laboratory.rendered(0, 0)
        self.n_looks += 1
        return self.steering.look(world_from_dome, time_s)


def _run(laboratory: Laboratory) -> Outcome:
    eye, log = _dive(laboratory)
    time_s = np.array([t for t, _, _ in eye.seen])
    valid = np.array([bool(posture) for _, posture, _ in eye.seen])
    errors = _errors(eye)
    found = errors[valid]
    rms = np.sqrt(np.mean(found**2, axis=0))
    share = 100.0 * float(valid.mean())
    depth = log.column("depth")
    return Outcome(
        sentence=f"Sinking from {depth[0]:.1f} to {depth[-1]:.1f} m along a net that moves, range "
        f"is told within {rms[0]:.2f} % and yaw within {rms[2]:.2f} degrees (rms) in {share:.0f} % "
        "of the pictures.",
        findings=(
            Finding(
                what="pictures with a posture (%)",
                paper="",
                ours=f"{share:.0f} of {len(valid)}",
                bar=f">= {_BAR_VALID:g}",
                met=share >= _BAR_VALID,
            ),
            Finding(
                what="rms error of the range (%)",
                paper="",
                ours=f"{rms[0]:.3f}",
                bar=f"<= {_BAR_PERCENT}",
                met=bool(rms[0] <= _BAR_PERCENT),
            ),
            Finding(
                what="rms error of pitch, yaw (degrees)",
                paper="",
                ours=f"{rms[1]:.3f}, {rms[2]:.3f}",
                bar=f"<= {_BAR_DEG}",
                met=bool(rms[1:].max() <= _BAR_DEG),
            ),
            Finding(
                what="correlation of heading and target yaw",
                paper="some",
                ours=f"{_correlation(log):+.2f}",
            ),
        ),
        pictures=(
            Picture(
                name="figure_22",
                caption="Depth, range, heading and yaw of the net over the dive, beside figure "
                "22. Dots: measured in rendered pictures; lines: truth.",
                figure=_drawn(eye, log, valid),
            ),
        ),
        series=(_series(eye, time_s),),
        notes=(
            "A simulated BlueROV2 in a current of 0.15 m/s and waves of 0.1 m before a net of a "
            "cage of 20 m radius that sways and rocks. It is steered by postures with sampled "
            "noise at 25 Hz, and every tenth picture is rendered and measured; `aqualvs follow "
            "--sim --rendered` renders all of them.",
            "A vehicle that turns to the right sees a net that turns to the left: heading and yaw "
            "go against each other here, where yaw is positive to the right. What the net itself "
            "does weakens that, at sea as here.",
            "Range and angles count against the tangent plane of the net at the nearest point, a "
            "twine's radius behind the light.",
        ),
    )


def _dive(laboratory: Laboratory) -> tuple[_Watched, LoopLog]:
    net = NetWall(curvature=-1.0 / 20.0, sway=0.04, sway_period=9.0, rock=math.radians(3.0))
    model = vehicle_model("bluerov2")
    case = SimCase(
        model=model,
        gains=load_gains(model.name),
        water=sea(current=0.15, waves=0.1, seed=_SEED),
        net=net,
        start_range=_RANGE,
        seed=_SEED,
    )
    scene = Scene(
        dome_from_scene=SE3.identity(),
        nets=(Net(bar=0.025, twine=0.0022, fouling=0.2, seed=_SEED),),
        target="net",
    )
    eye = _Watched(
        net,
        SampledEye(net, np.random.default_rng([_SEED, 1])),
        RenderedEye(net, laboratory.rig, np.random.default_rng([_SEED, 2]), scene),
        laboratory,
    )
    loop = case.loop(eye, _Descent(Setpoint(_RANGE)))
    return eye, loop.run(_SECONDS)


def _errors(eye: _Watched) -> FloatArray:
    """Return errors of range in percent, pitch and yaw in degrees; NaN where refused."""
    rows = np.full((len(eye.seen), 3), np.nan)
    for i, (_, posture, truth) in enumerate(eye.seen):
        if isinstance(posture, Posture):
            rows[i] = (
                100.0 * (posture.range / truth.range - 1.0),
                math.degrees(posture.pitch - truth.pitch),
                math.degrees(posture.yaw - truth.yaw),
            )
    return rows


def _correlation(log: LoopLog) -> float:
    heading = np.unwrap(log.column("heading"))
    return float(np.corrcoef(heading, log.column("yaw"))[0, 1])


def _measured(eye: _Watched) -> FloatArray:
    """Return range (m), pitch and yaw (deg) measured, NaN where refused; shape (N, 3)."""
    return np.array(
        [
            (p.range, math.degrees(p.pitch), math.degrees(p.yaw))
            if isinstance(p, Posture)
            else (math.nan,) * 3
            for _, p, _ in eye.seen
        ]
    )


def _series(eye: _Watched, time_s: FloatArray) -> Series:
    measured = _measured(eye)
    truth = [(t.range, math.degrees(t.pitch), math.degrees(t.yaw)) for _, _, t in eye.seen]
    names = ("range_m", "pitch_deg", "yaw_deg")
    columns: dict[str, FloatArray] = {"time_s": time_s}
    for k, name in enumerate(names):
        columns[f"true_{name}"] = np.array(truth)[:, k]
        columns[name] = measured[:, k]
    return Series(name="sea", columns=columns)


def _drawn(eye: _Watched, log: LoopLog, valid: FloatArray) -> "Figure":
    from matplotlib import rc_context

    time_s, seen_s = log.column("time_s"), np.array([t for t, _, _ in eye.seen])
    measured = _measured(eye)
    with rc_context(dict(STYLE)):
        figure = new_figure(5.0)
        depth, ranges, angles = figure.subplots(3, 1, sharex=True)
        depth.plot(time_s, log.column("depth"), color=BLUE)
        depth.invert_yaxis()
        depth.set_ylabel("depth (m)")
        ranges.plot(time_s, log.column("range"), color=DARK, alpha=0.5, label="true")
        ranges.plot(seen_s[valid], measured[valid, 0], ".", color=BLUE, label="measured")
        ranges.set_ylabel("range (m)")
        ranges.legend(loc="upper right", ncols=2)
        heading = np.degrees(np.unwrap(log.column("heading")))
        angles.plot(time_s, heading - heading[0], color=ORANGE, label="heading, from its start")
        angles.plot(time_s, np.degrees(log.column("yaw")), color=DARK, alpha=0.5, label="true yaw")
        angles.plot(seen_s[valid], measured[valid, 2], ".", color=BLUE, label="measured yaw")
        angles.axhline(0.0, color=GREY, linewidth=0.6)
        angles.set_ylabel("angle (degrees)")
        angles.set_xlabel("time (s)")
        angles.legend(loc="upper right", ncols=3)
        for axes in (ranges, angles):
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.25 * (high - low))
        figure.align_ylabels((depth, ranges, angles))
    return figure


EXPERIMENT = Experiment(
    name="sea",
    title="Down along a net at sea",
    paper="section 5.5, figure 22",
    about="The vehicle sinks along the net of a cage in current and waves, keeping its distance; "
    "the net sways and rocks. Depth and heading come from the vehicle's own sensors.",
    run=_run,
)
