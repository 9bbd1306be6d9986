"""`aqualvs tune`: gains for a vehicle, with the margins they leave and a step in the simulator."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from aqualvs.app.overwriting import Claim
from aqualvs.control.gains_file import gains_text, save_gains
from aqualvs.control.tune import Tuned, TuneOptions, tune
from aqualvs.control.tune_margins import Margins
from aqualvs.control.tune_step import StepOptions, simulate_step
from aqualvs.errors import OptionError
from aqualvs.simulation.vehicle_models import VEHICLES, VehicleModel


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneRequest:
    """What the command line asks for.

    Attributes
    ----------
    model : str
        Name of a vehicle model.
    output : Path or None
        Gains file; None prints the gains.
    overwrite : bool
        Whether to replace a file that this command wrote before.
    options : TuneOptions
        What the loops must stand.
    """

    model: str
    output: Path | None = None
    overwrite: bool = False
    options: TuneOptions = field(default_factory=TuneOptions)


def tune_and_tell(request: TuneRequest, tell: Callable[[str], None]) -> None:
    """Tune, try a step, write or print the gains.

    Raises
    ------
    OptionError
        If the model is unknown, or nothing stands what is asked.
    OutputError
        If the file cannot be written.
    """
    model = VEHICLES.get(request.model)
    if model is None:
        raise OptionError(f"tune {request.model}: no such model; use one of {', '.join(VEHICLES)}")
    files = [] if request.output is None else [request.output]
    with Claim("tune", files, overwrite=request.overwrite):
        tuned = tune(model, request.options)
        for line in report(model, tuned, request.options):
            tell(line)
        if request.output is None:
            tell(gains_text(tuned.gains))
        else:
            save_gains(tuned.gains, request.output)
            tell(f"written to {request.output}")


def report(model: VehicleModel, tuned: Tuned, options: TuneOptions) -> list[str]:
    """Return what to say of gains: margins at both delays, as it is and at worst; steps."""
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
        f"  {axis:5} {1e3 * delay:4.0f} ms, {which:9}  {_row(one)}"
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


def _row(one: Margins) -> str:
    return (
        f"{one.crossover:5.2f} rad/s  {math.degrees(one.phase):4.0f}°  {one.gain:5.2f}  "
        f"{1e3 * one.delay:4.0f} ms  {one.modulus:.2f}"
    )
