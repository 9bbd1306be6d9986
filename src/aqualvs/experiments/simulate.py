"""`aqualvs simulate`: a dive with known truth, or pictures for a calibration."""

import itertools
import shlex
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import astuple, replace
from pathlib import Path

from aqualvs.errors import OptionError, RigError
from aqualvs.optics.lens import LensModel
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.rigschema import parse_rig
from aqualvs.optics.solved import with_exact_numbers
from aqualvs.results.files import Claim, writing
from aqualvs.simulation.calibration_set import (
    CalibrationFiles,
    SetSize,
    check_set,
    port_folder,
    simulate_calibration,
)
from aqualvs.simulation.cameras import SimulatedCamera, simulated_camera
from aqualvs.simulation.dive import (
    LEAD_S,
    check_dive,
    check_motion,
    shutter_from_words,
    simulate_dive,
    write_hole_truth,
    write_vehicle_log,
)
from aqualvs.simulation.scenarios import example_rig, list_scenarios, load_scenario
from aqualvs.simulation.scene import CameraSensor
from aqualvs.terminal import Echo, StopSignals, Tick, progress
from aqualvs.text import count_text
from aqualvs.yamlfile import read_yaml

CALIBRATION = "calibration"
"""Argument, instead of a scenario, for pictures for a calibration."""

_ABOUT_CALIBRATION = "no dive: pictures for all four steps of a calibration, with the truth"
_NO_POSTURE = (
    "truth.csv states no posture, for it has those of a net, or of a wall with behind_mm, yaw_deg "
    "and pitch_deg of 0; move and tilt such a wall by motion"
)
_LOG, _HOLES = "vehicle.csv", "truth_holes.csv"
_FILES = ("dive.mp4", "truth.csv", "rig.yaml", _LOG, _HOLES)


def simulate(
    scenario: str | None,
    rig_file: Path | None,
    out: Path | None,
    echo: Echo,
    *,
    camera: str,
    shutter: str | None = None,
    overwrite: bool,
) -> int:
    """Render a scenario into a folder and print how to run it.

    Options are those of `aqualvs simulate`, see its `--help`; the scenario `CALIBRATION` renders
    pictures for a calibration. SIGINT and SIGTERM end it after the present frame; the frames so far
    can be used. Returns 0, or 128 + signal if it was stopped. Raises `AqualvsError` if scenario,
    camera, rig or folder cannot be used.
    """
    if scenario is None:
        raise OptionError("SCENARIO: missing; choose one from aqualvs simulate --list")
    if out is None:
        raise OptionError("--out: missing; give the folder to write")
    model = simulated_camera(camera)
    if scenario == CALIBRATION:
        if shutter is not None:
            raise OptionError(
                "--shutter: boards stand still, so it would show nothing; leave it out, or choose "
                "a dive"
            )
        return _simulate_calibration(rig_file, out, echo, camera=model, overwrite=overwrite)
    course = load_scenario(scenario)
    if model.development is not None and course.sensor != CameraSensor():
        raise OptionError(
            f"scenario {scenario}: sensor: --camera {camera} has its own; leave it out, or choose "
            "--camera ideal"
        )
    rig = example_rig() if rig_file is None else load_rig(rig_file)
    if shutter is not None:
        rig = replace(rig, shutter=shutter_from_words(shutter, course.fps))
    elif course.shutter is not None:
        place = f"scenario {scenario}: shutter"
        rig = replace(rig, shutter=shutter_from_words(course.shutter, course.fps, place))
    check_dive(rig, course.fps, model.recording, rig_file)
    check_motion(course, rig.shutter, f"scenario {scenario}: motion")
    claim = Claim("simulate", [out / name for name in _FILES], overwrite=overwrite)
    video, truth = out / "dive.mp4", out / "truth.csv"
    with claim, writing(out), StopSignals() as stop, progress(scenario, course.n_frames) as tick:
        out.mkdir(parents=True, exist_ok=True)
        if course.nets:
            write_vehicle_log(course, out / _LOG)
            write_hole_truth(course, out / _HOLES)
        save_rig(with_exact_numbers(rig), out / "rig.yaml")
        stopped = None
        try:
            simulate_dive(course, rig, out, progress=_stopping(stop, tick), camera=model)
        except _StoppedError as early:
            stopped = early
    echo(f"{stopped or count_text(course.n_frames, 'frame')}: {video}, truth: {truth}")
    if course.target == "none" and (course.walls or course.boxes):
        echo(f"note: {_NO_POSTURE}")
    run = ["run", video, "--rig", out / "rig.yaml", "--truth", truth, "-o", out / "run"]
    commands = [[str(word) for word in run]]
    if course.nets:
        echo(f"true holes: {out / _HOLES}")
    # Without lasers there is nothing to say of a net.
    if course.nets and course.lasers_on:
        log = ["--log", str(out / _LOG), "--log-offset-s", f"{LEAD_S:g}"]
        commands.append(["net", str(out / "run"), *log])
    _echo_commands(commands, echo)
    return stop.exit_code if stopped else 0


class _StoppedError(Exception):
    """Rendering was stopped by a signal after a complete picture."""

    def __init__(self, signal: str, n_done: int, n_all: int, unit: str) -> None:
        super().__init__(f"stopped by {signal} after {n_done} of {n_all} {unit}")
        self.n_done = n_done


def _stopping(
    stop: StopSignals, tick: Tick, *, unit: str = "frames", not_at: Collection[int] = ()
) -> Callable[[int, int], None]:
    """Return a `progress` callback of renderers that ends them after a signal.

    It raises `_StoppedError`, but not after the last picture, nor after the pictures `not_at`.
    """

    def after(n_done: int, n_all: int) -> None:
        tick(1)
        if stop.caught and n_done < n_all and n_done not in not_at:
            raise _StoppedError(stop.caught.name, n_done, n_all, unit)

    return after


def _simulate_calibration(
    rig_file: Path | None, out: Path, echo: Echo, *, camera: SimulatedCamera, overwrite: bool
) -> int:
    """Render the pictures of a calibration and print the commands that use them."""
    rig, size = example_rig() if rig_file is None else load_rig(rig_file), SetSize()
    check_set(rig, size, camera, rig_file)
    # In the order in which they are rendered.
    folders = ("camera_air", port_folder(rig), "box", "index", "dive")
    files_of_set = [out / name for name in (*folders, "truth", "nominal.yaml")]
    claim = Claim("simulate", files_of_set, overwrite=overwrite)
    # A folder is complete when the picture after its last one begins: files follow its pictures.
    ends = dict(zip(folders, itertools.accumulate(astuple(size)), strict=True))
    with (
        claim,
        writing(out),
        StopSignals() as stop,
        progress(CALIBRATION, size.total, "pictures") as tick,
    ):
        after = _stopping(stop, tick, unit="pictures", not_at=ends.values())
        try:
            files = simulate_calibration(rig, out, size=size, progress=after, camera=camera)
        except _StoppedError as early:
            complete = [name for name, end in ends.items() if end < early.n_done]
            echo(f"{early}; complete in {out}: {', '.join(complete) or 'nothing'}")
            return stop.exit_code
    echo(f"{files.n_pictures} pictures and frames in {out}, truth: {files.rig}")
    _echo_commands(calibration_commands(files, out, rig, _seawater(rig_file)), echo)
    return 0


def _echo_commands(commands: Iterable[Sequence[str]], echo: Echo) -> None:
    """Print commands of `aqualvs`, each on a line of its own, to be pasted into a shell."""
    echo("next:")
    for command in commands:
        echo(f"  aqualvs {shlex.join(command)}")


def _seawater(rig_file: Path | None) -> tuple[float, float] | None:
    """Return the temperature, in °C, and salinity, in per mille, by which a file gives the water.

    None if it gives the index instead.
    """
    if rig_file is None:
        return None
    water = parse_rig(read_yaml(rig_file, "a rig file", RigError), str(rig_file)).water
    if water is None or water.temperature_c is None or water.salinity_permille is None:
        return None
    return water.temperature_c, water.salinity_permille


def calibration_commands(
    files: CalibrationFiles, out: Path, rig: Rig, seawater: tuple[float, float] | None = None
) -> list[list[str]]:
    """Return the arguments of the `aqualvs` commands that calibrate from a simulated set.

    `out`: folder for `rig.yaml` and `run`. `rig`: the true one. `seawater`: temperature, in
    °C, and salinity, in per mille, of its water, if they are known.
    """
    file = str(out / "rig.yaml")
    update = ["--rig", file, "-o", file]
    model = [] if rig.lens.model is LensModel.OPENCV else ["--model", rig.lens.model.value]
    known = [f"--board={files.board}", f"--nominal={files.nominal}", *model]
    camera = [str(files.camera), *known, "-o", file]
    poses = ["--medium=water"] if files.poses is None else [f"--poses={files.poses}"]
    dome = [str(files.dome), f"--board={files.rail_board}", *poses, *update]
    lasers = [str(files.box), f"--box={files.box_file}", f"--lasers={len(rig.lasers)}", *update]
    measured = []
    if seawater is not None:
        measured = [f"--temperature-c={seawater[0]:g}", f"--salinity={seawater[1]:g}"]
    water = [str(files.index), f"--target={files.target}", *measured, *update]
    steps = {"camera": camera, "dome": dome, "lasers": lasers, "water": water}
    commands = [["calibrate", step, *arguments] for step, arguments in steps.items()]
    commands.append(["check", file, "--against", str(files.rig)])
    if files.dive is not None:
        dive = [str(files.dive), "--rig", file, "--truth", str(files.dive_truth)]
        commands.append(["run", *dive, "-o", str(out / "run")])
    return commands


def print_scenarios(echo: Echo) -> None:
    """Print the built-in scenarios, one line each."""
    scenarios = {**list_scenarios(), CALIBRATION: _ABOUT_CALIBRATION}
    width = max(map(len, scenarios))
    for name, about in scenarios.items():
        echo(f"{name:{width}}  {about}")
