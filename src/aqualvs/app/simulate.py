"""`aqualvs simulate`: a dive with known truth, ready for `aqualvs run`."""

from collections.abc import Callable
from pathlib import Path

from aqualvs.app.disk import writing
from aqualvs.app.progress import progress
from aqualvs.errors import OptionError, OutputError
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.simulation.dive import simulate_dive
from aqualvs.simulation.example_rigs import example_rig
from aqualvs.simulation.scenarios import list_scenarios, load_scenario

_FILES = ("dive.mp4", "truth.csv", "rig.yaml")


def simulate(
    scenario: str | None,
    rig_file: Path | None,
    out: Path | None,
    tell: Callable[[str], object],
    *,
    overwrite: bool,
) -> None:
    """Render a scenario into a folder and tell how to run it.

    Parameters
    ----------
    scenario : str or None
        Built-in name or path of a YAML file.
    rig_file : Path or None
        None takes the example rig.
    out : Path or None
        Folder to write.
    tell : callable
        Takes one line of text.
    overwrite : bool
        Whether a dive that is already there may be replaced.

    Raises
    ------
    AqualvsError
        If scenario, rig or folder cannot be used.
    """
    if scenario is None:
        raise OptionError("SCENARIO: missing; choose one from aqualvs simulate --list")
    if out is None:
        raise OptionError("--out: missing; give the folder to write")
    course = load_scenario(scenario)
    rig = example_rig() if rig_file is None else load_rig(rig_file)
    _check_free(out, overwrite=overwrite)
    with writing(out), progress(scenario, course.n_frames) as tick:
        dive = simulate_dive(course, rig, out, progress=lambda _done, _all: tick(1))
        save_rig(rig, out / "rig.yaml")
    tell(f"{dive.n_frames} frames: {dive.video}, truth: {dive.truth}")
    tell(
        f"next: aqualvs run {dive.video} --rig {out / 'rig.yaml'} --truth {dive.truth} "
        f"-o {out / 'run'}"
    )


def tell_scenarios(tell: Callable[[str], object]) -> None:
    """Tell the built-in scenarios, one line each."""
    scenarios = list_scenarios()
    width = max(map(len, scenarios))
    for name, about in scenarios.items():
        tell(f"{name:{width}}  {about}")


def _check_free(out: Path, *, overwrite: bool) -> None:
    found = [out / name for name in _FILES if (out / name).exists()]
    if found and not overwrite:
        raise OutputError(f"{found[0]}: exists; choose another folder or add --overwrite")
