"""Commands that the documentation names: all are understood, and those that can be are run.

`first-dive.md` and `tour.md` are run as they stand, from top to bottom, each command as a process
but those that render; what other pages name is run on the files that these two leave behind.
"""

import contextlib
import dataclasses
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from aqualvs.cli.main import app, main
from aqualvs.experiments import simulate
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scenarios import load_scenario
from doc_blocks import PAGES, ROOT, Command, all_commands, commands
from waiting import TIMEOUT_S

ELSEWHERE = {
    r"^(live|doctor) ": "needs a stream: tests/live",
    r"^follow udp": "needs a vehicle: tests/live",
    r"^follow --sim --rendered": "takes minutes: tests/recovery/test_closed_loop.py",
    r"^follow --sim( --vehicle bluerov2-heavy)? .*-o out$": "as in first-dive.md, longer",
    r"^simulate .* --camera": "takes a minute: tests/cli/test_simulate.py",
    r"^simulate net_holes": "takes minutes: tests/cli/test_net.py",
    r"^net out/sim/run --log out/sim/vehicle.csv": "of the same dive",
    r"--log vehicle.tlog": "a real log: tests/vehicle_logs/test_mavlink_frames.py",
    r"^run dives/dive_": "a recording's name differs: tests/live",
    r"^import ": "files of other programs: tests/cli/test_formats.py",
    r"^calibrate ": "file names of the user's own: the tour runs all four steps",
    r"^board box|^board plate": "tests/calibration/targets/test_targets.py",
    r"^(benchmark|score) ": "takes minutes: tests/cli/test_score.py",
    r"^reproduce( -o| distance)": "takes minutes: tests/cli/test_reproduce.py",
    r"^batch ": "tests/cli/test_batch.py",
    r"^net-change ": "tests/cli/test_net_change.py",
    r"^design --rig": "needs nothing but a rig; tests/cli/test_design.py",
}
IN_ORDER = ("first-dive.md", "tour.md")


def arguments_of(command: Command) -> str:
    return shlex.join(command.arguments)


def understood(arguments: list[str]) -> None:
    """Parse as the command line does, without running anything."""
    command, rest = typer.main.get_command(app), list(arguments)
    while hasattr(command, "commands"):
        command = command.commands[rest.pop(0)]
    command.make_context(command.name, rest)


def examples() -> list[Command]:
    """The example in the help of every command."""
    found = []
    group = typer.main.get_command(app)
    pairs = [(name, one) for name, one in group.commands.items()]
    for name, one in list(pairs):
        pairs += [(f"{name} {k}", v) for k, v in getattr(one, "commands", {}).items()]
    for name, one in pairs:
        if not getattr(one, "commands", None):
            example = re.search(r"Example: aqualvs (.*)", one.epilog or "", re.DOTALL)
            assert example, f"aqualvs {name}: no example in its help"
            found.append(Command("--help", shlex.split(example[1]), None))
    return found


@pytest.mark.parametrize("command", [*all_commands(), *examples()], ids=str)
def test_the_command_is_understood(command):
    understood(command.arguments)


def test_a_wrong_option_is_not_understood():
    with pytest.raises(Exception, match="no-such-option"):
        understood(["run", "dive.mp4", "--no-such-option", "-o", "out"])


AGAIN = {
    "board",
    "demo",
    "design",
    "export",
    "figures",
    "follow",
    "run",
    "score",
    "simulate",
    "tune",
}


def few_frames(name: str) -> Scenario:
    """A scenario by its name, of six frames a second in place of twenty-five."""
    return dataclasses.replace(load_scenario(name), fps=6.0)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A user's folder after the first dive and the tour."""
    folder = tmp_path_factory.mktemp("user")
    for name in IN_ORDER:
        for command in commands(ROOT / "docs" / name):
            if command.arguments[0] == "simulate":
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr(simulate, "load_scenario", few_frames)
                    run_here(command, folder)
            else:
                run(command, folder)
    shutil.copy(folder / "out/cal/rig.yaml", folder / "rig.yaml")
    # The copy that the calibration of a year ago would have left.
    older = re.sub(r"(date: ')\d{4}", r"\g<1>2025", (folder / "rig.yaml").read_text("utf-8"))
    (folder / "rig.2026-01-08T093000.yaml").write_text(older, encoding="utf-8")
    shutil.copy(folder / "out/sim/dive.mp4", folder / "dive.mp4")
    shutil.copy(folder / "out/sim/rig.yaml", folder / "other.yaml")
    shutil.copy(ROOT / "examples/plan_follow.yaml", folder / "plan.yaml")
    return folder


def repeatable(command: Command) -> list[str]:
    """Pages repeat each other's commands; what is there may be written again."""
    again = command.arguments[0] in AGAIN and "-o" in command.arguments
    return [*command.arguments, *(["--overwrite"] if again else [])]


def run(command: Command, folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "aqualvs", *repeatable(command)],
        cwd=folder,
        capture_output=True,
        text=True,
        # The first of them compile most kernels.
        timeout=5 * TIMEOUT_S,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-800:]}{done.stderr[-800:]}"
    write_output(command, folder, done.stdout)


def run_here(command: Command, folder: Path) -> None:
    """Run without the second or two that a process takes to begin."""
    said = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said):
        code = main(repeatable(command))
    assert code == 0, f"{command}\n{said.getvalue()[-800:]}"
    write_output(command, folder, said.getvalue())


def write_output(command: Command, folder: Path, said: str) -> None:
    if command.into is not None:
        (folder / command.into).write_text(said, encoding="utf-8")


def why_elsewhere(command: Command) -> str | None:
    line = arguments_of(command)
    return next((why for what, why in ELSEWHERE.items() if re.search(what, line)), None)


def others() -> list[Command]:
    """What the other pages name, each line once."""
    ordered = {arguments_of(c) for name in IN_ORDER for c in commands(ROOT / "docs" / name)}
    found = {}
    for page in PAGES:
        for command in commands(page) if page.name not in IN_ORDER else []:
            line = arguments_of(command)
            if line not in ordered and why_elsewhere(command) is None:
                found.setdefault(line, command)
    return list(found.values())


def test_the_first_dive_and_the_tour_run_as_they_stand(world):
    assert (world / "out/demo/report.html").exists()
    assert (world / "out/follow").is_dir()
    assert (world / "out/cal/run/posture.csv").exists()


def test_the_other_pages_commands_run(world):
    for command in others():
        run_here(command, world)


def test_what_is_said_to_run_elsewhere_is_still_named():
    lines = [arguments_of(command) for command in all_commands()]
    for what in ELSEWHERE:
        assert any(re.search(what, line) for line in lines), what
