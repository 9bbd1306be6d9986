"""Commands that the documentation names: all are understood, and those that can be are run.

The README, `first-dive.md` and `tour.md` are run as they stand, from top to bottom in one empty
folder, and every file that they name is there afterwards. What other pages name is run on the files
that these leave behind. Most run in this process: every new one loads its kernels again.
"""

import contextlib
import dataclasses
import functools
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from aqualvs.cli.main import main, program
from aqualvs.experiments import simulate
from aqualvs.simulation import dive
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scenarios import load_scenario
from doc_blocks import PAGES, Command, all_commands, commands
from dome_cases import leave_bare_lenses_out
from net_app_cases import leave_maps_blank
from panel_cases import small_rig
from ports import free_port
from repository import ROOT
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
    r"--rerun ": "needs an extra that is not in dev: tests/test_pipeline.py",
    r"^import ": "files of other programs: tests/cli/test_formats.py",
    r"^calibrate ": "file names of the user's own: the tour runs all four steps",
    r"^board box|^board plate": "tests/calibration/targets/test_targets.py",
    r"^(benchmark|score) ": "takes minutes: tests/cli/test_score.py",
    r"^reproduce( -o| distance)": "takes minutes: tests/cli/test_reproduce.py",
    r"^batch /mnt": "needs a cluster: tests/batch/test_cluster.py",
    r"^net-change out/2026": "dives along one net, by logs: tests/cli/test_net_change.py",
    r"^design (--rig|--image .*--lens-mm|design.yaml)": "as the README's; tests/cli/test_design.py",
}
IN_ORDER = (ROOT / "README.md", ROOT / "docs" / "first-dive.md", ROOT / "docs" / "tour.md")
# Commands that begin processes or threads of their own, or are the first that a user types: each is
# a process once.
AS_A_PROCESS = {"batch", "demo", "live"}


def arguments_of(command: Command) -> str:
    return shlex.join(command.arguments)


def understood(arguments: list[str]) -> None:
    """Parse as the command line does, without running anything."""
    command, rest = program(), list(arguments)
    while hasattr(command, "commands"):
        command = command.commands[rest.pop(0)]
    command.make_context(command.name, rest)


def examples() -> list[Command]:
    """The example in the help of every command."""
    found = []
    group = program()
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
    """A scenario by its name, of four frames a second in place of twenty-five."""
    return dataclasses.replace(load_scenario(name), fps=4.0)


save_figure = Figure.savefig


def save_coarsely(figure: Figure, path: Path, **options: Any) -> None:
    """Save a figure that nobody looks at, whatever its resolution would be."""
    save_figure(figure, path, **{**options, "dpi": 40})


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A user's folder after the first dive and the tour."""
    folder = tmp_path_factory.mktemp("user")
    with pytest.MonkeyPatch.context() as patch:
        # Rendering would be most of the time: small pictures of one ray a pixel, and few of them.
        patch.setattr(dive, "Renderer", functools.partial(Renderer, samples=1))
        patch.setattr(simulate, "load_scenario", few_frames)
        patch.setattr(simulate, "example_rig", small_rig)
        leave_bare_lenses_out(patch)
        # tests/cli/test_net.py draws maps; the other figures are there, but coarse.
        leave_maps_blank(patch)
        patch.setattr(Figure, "savefig", save_coarsely)
        begun = set()
        for command in {arguments_of(c): c for page in IN_ORDER for c in commands(page)}.values():
            word = command.arguments[0]
            alone = word in AS_A_PROCESS and word not in begun
            (run_as_process if alone else run_here)(command, folder)
            begun.add(word)
    named = {path for page in IN_ORDER for path in files_named(page)}
    assert [path for path in sorted(named) if not (folder / path).exists()] == []
    shutil.copy(folder / "out/cal/rig.yaml", folder / "rig.yaml")
    # The copy that the calibration of a year ago would have left.
    older = re.sub(r"(date: ')\d{4}", r"\g<1>2025", (folder / "rig.yaml").read_text("utf-8"))
    (folder / "rig.2026-01-08T093000.yaml").write_text(older, encoding="utf-8")
    shutil.copy(folder / "out/sim/dive.mp4", folder / "dive.mp4")
    shutil.copytree(folder / "out/sim/run", folder / "out/dive")
    shutil.copy(folder / "out/sim/rig.yaml", folder / "other.yaml")
    shutil.copy(ROOT / "examples/plan_follow.yaml", folder / "plan.yaml")
    season = folder / "season" / "2026"
    season.mkdir(parents=True)
    for date in ("2026-05-01", "2026-06-14"):
        shutil.copy(folder / "dive.mp4", season / f"{date}.mp4")
    rows = "".join(f"season/2026/{path.name},rig.yaml\n" for path in sorted(season.iterdir()))
    (folder / "season.csv").write_text(f"dive,rig\n{rows}", encoding="utf-8")
    return folder


def files_named(page: Path) -> set[str]:
    """Files and folders that a page's commands write, and those below them that its text names."""
    text = page.read_text(encoding="utf-8")
    written = {match[1] for match in re.finditer(r"^ {4}aqualvs .* -o (\S+)", text, re.MULTILINE)}
    targets = {f"{one}.yaml" if one == "board" else one for one in written}
    return targets | {match[1] for match in re.finditer(r"`((?:out/|board\.)[\w./]+)`", text)}


def repeatable(command: Command, folder: Path) -> list[str]:
    """Return the arguments as the shell would expand them, on a port of the test's own.

    Pages repeat each other's commands; what is there may be written again.
    """
    arguments = []
    for word in command.arguments:
        found = [str(path.relative_to(folder)) for path in folder.glob(word)] if "*" in word else []
        arguments += found or [word]
    if command.arguments[0] in AGAIN and "-o" in command.arguments:
        arguments.append("--overwrite")
    if "--dashboard" in arguments:
        arguments += ["--dashboard-address", f"127.0.0.1:{free_port()}"]
    return arguments


def run_as_process(command: Command, folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "aqualvs", *repeatable(command, folder)],
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
        code = main(repeatable(command, folder))
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
    ordered = {arguments_of(c) for page in IN_ORDER for c in commands(page)}
    found = {}
    for page in PAGES:
        for command in commands(page) if page not in IN_ORDER else []:
            line = arguments_of(command)
            if line not in ordered and why_elsewhere(command) is None:
                found.setdefault(line, command)
    return list(found.values())


def test_the_first_pages_run_as_they_stand(world):
    assert (world / "out/demo/report.html").exists()
    assert "out/follow/follow.html" in files_named(ROOT / "README.md")
    assert "out/cal/run" in files_named(ROOT / "docs" / "tour.md")


def test_the_other_pages_commands_run(world):
    for command in others():
        run_here(command, world)


def test_what_is_said_to_run_elsewhere_is_still_named():
    lines = [arguments_of(command) for command in all_commands()]
    for what in ELSEWHERE:
        assert any(re.search(what, line) for line in lines), what
