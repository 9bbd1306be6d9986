"""The command `aqualvs tune`: gains for a vehicle, their margins, and a step of the range.

The step is simulated with the nonlinear vehicle, to verify the linear model that tuning uses.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains import ControlGains
from aqualvs.control.gains_file import gains_text, save_gains
from aqualvs.control.tune import Tuned, TuneOptions, shaping_of_model, tune
from aqualvs.control.vehicle import Setpoint
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.results.files import Claim
from aqualvs.simulation.vehicle.models import VEHICLES, VehicleModel
from aqualvs.simulation.vehicle.vehicle import SimulatedVehicle
from aqualvs.simulation.vehicle.water_motion import WaterMotion
from aqualvs.terminal import Echo

# Distance of the wall north of the origin, and depth of the vehicle, in metres.
_WALL, _DEPTH = 5.0, 5.0
# Time before the step, to settle, and after it.
_REST_S, _AFTER_S = 6.0, 12.0
# The step has settled when the error stays below this share of it.
_BAND = 0.05


@dataclass(frozen=True, slots=True)
class StepOptions:
    """Options of the simulated step."""

    # Ranges before and after, in metres.
    begin: float = 0.8
    end: float = 0.6
    delay: float = 0.1  # Delay from a frame to its effort at the vehicle, in seconds.
    frame: float = 0.04  # Seconds between frames.


@dataclass(frozen=True, slots=True)
class StepAnswer:
    """Response to the step."""

    # Shape (N,): seconds since the step, from before it on; metres.
    time: FloatArray
    range: FloatArray
    overshoot: float  # As a share of the step.
    # Seconds after which the range stays within 5 % of the step; infinite if it does not.
    settling: float


def simulate_step(
    model: VehicleModel, gains: ControlGains, options: StepOptions | None = None
) -> StepAnswer:
    """Simulate a step of the range to a wall in still water, with exact postures.

    `model` may differ from the one that the gains are tuned for.
    """
    options = options or StepOptions()
    ahead = _WALL - options.begin - model.dome_position[0]
    pose = SE3(np.eye(3), np.array([ahead, 0.0, _DEPTH]))
    vehicle = SimulatedVehicle(
        model, WaterMotion(), np.random.default_rng(0), pose, latency=options.delay
    )
    controller, shaping = RangeYawController(gains), shaping_of_model(model)
    n_rest, n_after = (round(span / options.frame) for span in (_REST_S, _AFTER_S))
    time = options.frame * np.arange(-n_rest, n_after, dtype=np.float64)
    ranges = np.empty(len(time))
    before = _posture(vehicle)
    for k, now in enumerate(time.tolist()):
        goal = options.begin if now < 0.0 else options.end
        ranges[k], yaw = _posture(vehicle)
        rates = ((ranges[k] - before[0]) / options.frame, (yaw - before[1]) / options.frame)
        before = (ranges[k], yaw)
        effort = controller.update(now, *before, *rates, Setpoint(goal))
        vehicle.step(shaping.position(effort), options.frame)
    return _answer(time, ranges, options)


def _posture(vehicle: SimulatedVehicle) -> tuple[float, float]:
    """Return range and yaw to the wall."""
    world_from_dome = vehicle.dome_pose
    normal = world_from_dome.rotation[0]
    return _WALL - float(world_from_dome.translation[0]), math.atan2(normal[0], normal[1])


def _answer(time: FloatArray, ranges: FloatArray, options: StepOptions) -> StepAnswer:
    after = time >= 0.0
    size = options.end - options.begin
    beyond = (ranges[after] - options.end) / size
    outside = np.flatnonzero(np.abs(beyond) > _BAND)
    last = int(outside[-1]) + 1 if len(outside) else 0
    settling = float(time[after][last]) if last < len(beyond) else math.inf
    return StepAnswer(time, ranges, max(0.0, float(beyond.max())), settling)


def run_tune(
    name: str,
    echo: Echo,
    options: TuneOptions | None = None,
    *,
    output: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Tune for a vehicle model, simulate a step, and write the gains, or print them if no file.

    Raises `OptionError` if the model is unknown, or no gains meet the requirements. Raises
    `OutputError` if the file cannot be written.
    """
    model, options = VEHICLES.get(name.replace("-", "_")), options or TuneOptions()
    if model is None:
        raise OptionError(f"tune {name}: no such model; use one of {', '.join(VEHICLES)}")
    with Claim("tune", [] if output is None else [output], overwrite=overwrite):
        tuned = tune(model, options)
        for line in report(model, tuned, options):
            echo(line)
        if output is None:
            echo(gains_text(tuned.gains))
        else:
            save_gains(tuned.gains, output)
            echo(f"written to {output}")


def report(model: VehicleModel, tuned: Tuned, options: TuneOptions) -> list[str]:
    """Return the report on gains: margins at both delays, nominal and worst case, and steps."""
    usual, most = options.delay, options.greatest_delay
    lines = [
        f"{model.name}: margins with the model as it is, and in the worst corner (mass "
        f"x{options.mass_factor:g}, drag x{options.drag_factor:g} either way, current to "
        f"{options.current:g} m/s)",
        f"  {'':26}crossover    phase   gain   delay  modulus",
    ]
    rows = (
        ("range", usual, "as it is", tuned.range_usual),
        ("range", usual, "worst", tuned.range_corner),
        ("range", most, "worst", tuned.range_late),
        ("yaw", usual, "as it is", tuned.yaw_usual),
        ("yaw", most, "worst", tuned.yaw_late),
    )
    lines += [
        f"  {axis:5} {1e3 * delay:4.0f} ms, {which:9}  {one.crossover:5.2f} rad/s  "
        f"{math.degrees(one.phase):4.0f}°  {one.gain:5.2f}  {1e3 * one.delay:4.0f} ms  "
        f"{one.modulus:.2f}"
        for axis, delay, which, one in rows
    ]
    for delay in (usual, most):
        step = StepOptions(delay=delay, frame=options.frame)
        answer = simulate_step(model, tuned.gains, step)
        lines.append(
            f"  step {step.begin:g} to {step.end:g} m in still water, delay {1e3 * delay:.0f} ms: "
            f"overshoot {100.0 * answer.overshoot:.1f} %, within 5 % after {answer.settling:.1f} s"
        )
    return lines
