"""The command line as a whole: help, version, and how fast it is there."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time

import pytest
import typer
import yaml

from aqualvs import __version__
from aqualvs.__main__ import interrupt
from aqualvs.cli import main as cli
from aqualvs.cli.command import CheckedCommand
from aqualvs.cli.main import main
from aqualvs.errors import AqualvsError
from report_cases import make_dive, write_truth
from shell_cases import rig_file
from waiting import until

COMMANDS = ("run", "simulate", "demo", "check", "report", "board")
HEAVY = {"numpy", "numba", "cv2", "av", "pydantic", "pyarrow", "scipy", "rich", "yaml"}


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["--version"]])
def test_help_needs_no_heavy_library(arguments):
    command = [sys.executable, "-X", "importtime", "-m", "aqualvs", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in lines}
    assert "typer" in imported
    # Typer itself checks values with Pydantic.
    allowed = set() if arguments == ["--help"] else {"pydantic"}
    assert imported & HEAVY <= allowed


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command, capsys):
    assert main([command, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"Example: aqualvs {command}" in said


@pytest.mark.parametrize("step", ["camera", "dome", "lasers", "water"])
def test_every_calibration_has_help_with_an_example(step, capsys):
    assert main(["calibrate", step, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"Example: aqualvs calibrate {step}" in said


def test_help_without_a_command_names_them_all(capsys):
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(command in said for command in COMMANDS)


def test_every_command_is_in_a_group(capsys):
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    titles = [line for line in said.splitlines() if re.fullmatch(r"[A-Z][a-z ]+:", line)]
    groups = ["Measure", "Calibrate", "Live and control", "Nets", "Simulate", "Reference"]
    assert titles == ["Options:", *(f"{group}:" for group in groups)]
    assert "..." not in said.partition("Measure:")[2]
    assert said.index("  calibrate ") < said.index("Live and control:")


def test_calibrate_without_a_step_prints_its_help(capsys):
    assert main(["calibrate", "--help"]) == 0
    shown = capsys.readouterr().out
    assert main(["calibrate"]) == 2
    assert capsys.readouterr().err == shown


def test_the_steps_of_calibrate_are_told_whole(capsys):
    assert main(["calibrate", "--help"]) == 0
    steps = capsys.readouterr().out.partition("Commands:")[2]
    assert "..." not in steps
    assert [line.split()[0] for line in steps.splitlines() if re.match(r"  \w", line)] == [
        "camera", "dome", "lasers", "water", "shutter",
    ]  # fmt: skip


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "powershell"])
def test_a_shell_can_complete(shell, monkeypatch, capsys):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    monkeypatch.setattr(cli, "program", cli.program.__wrapped__)
    with contextlib.suppress(SystemExit):
        main(["--show-completion", shell])
    assert f"complete_{shell}" in capsys.readouterr().out


def test_a_command_is_completed(monkeypatch, capsys):
    monkeypatch.setenv("_AQUALVS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "aqualvs run dive.mp4 --detector ")
    monkeypatch.setenv("COMP_CWORD", "4")
    with contextlib.suppress(SystemExit):
        main([])
    assert capsys.readouterr().out.split() == ["ridge", "threshold"]


def test_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"aqualvs {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "run x --water-n 1,33",
            "--water-n 1,33: write 1.33, with a decimal point; see aqualvs run",
        ),
        ("run x --water-n many", "--water-n many: give a number; see aqualvs run"),
        ("run x --workers 0", "--workers 0: give 1 or more; see aqualvs run"),
        ("run x --workers 5000", "--workers 5000: give at most 1024; see aqualvs run"),
        ("run x --workers 1,5", "--workers 1,5: give a whole number; see aqualvs run"),
        ("run x --detector foo", "--detector foo: give one of ridge, threshold; see aqualvs run"),
        (
            "board cube -o x",
            "KIND cube: give one of charuco, chessboard, box, plate; see aqualvs board",
        ),
        (
            "board plate -o x --position-mm 1 2,5 3",
            "--position-mm 2,5: write 2.5, with a decimal point; see aqualvs board",
        ),
        ("simulate wall -o", "Option '-o' requires an argument; see aqualvs simulate"),
        ("calibrate tank", "No such command 'tank'; see aqualvs calibrate"),
        ("tank", "No such command 'tank'; see aqualvs"),
        ("calibrate shutter x --fps a", "--fps a: give a number; see aqualvs calibrate shutter"),
    ],
)
def test_faults_of_the_parser_name_option_value_and_help(arguments, said, refused):
    assert refused(*arguments.split()) == f"{said} --help"


def test_faults_of_the_user_become_one_line(monkeypatch, refused):
    def fail(**_):
        raise AqualvsError("dive.mp4: odd; fix it")

    monkeypatch.setattr(cli, "program", lambda: fail)
    assert refused("run") == "dive.mp4: odd; fix it"


@pytest.mark.parametrize(
    ("place", "name"),
    [(CheckedCommand, "invoke"), (cli, "program"), (CheckedCommand, "make_context")],
)
def test_an_interrupted_command_exits_with_130_and_says_so(place, name, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(place, name, stop)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "aqualvs: error: interrupted\n"


def test_an_interrupt_while_llvm_compiles_is_neither_lost_nor_a_fault_of_the_compilation():
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    module = llvm.parse_assembly("define void @f() { ret void }")
    engine = llvm.create_mcjit_compiler(module, machine)
    compiled = []

    def interrupted_then_kept(_module, result):
        signal.raise_signal(signal.SIGINT)
        compiled.append(result)

    engine.set_object_cache(interrupted_then_kept, None)
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        engine.finalize_object()
        assert compiled
        with pytest.raises(KeyboardInterrupt):
            until(lambda: False, "the interrupt")
    finally:
        signal.signal(signal.SIGINT, before)


def test_faults_of_the_program_are_not_hidden(monkeypatch):
    def fail(**_):
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "program", lambda: fail)
    with pytest.raises(ZeroDivisionError):
        main(["run"])


def test_a_report_needs_a_run(tmp_path, refused):
    assert "holds no run" in refused("report", tmp_path / "missing")


def test_check_tells_a_sane_rig_from_a_useless_one(tmp_path, capfd, refused):
    rig = rig_file(tmp_path)
    assert main(["check", str(rig)]) == 0
    assert "This rig is sane" in capfd.readouterr().out
    content = yaml.safe_load(rig.read_text())
    rig.write_text(yaml.safe_dump({**content, "lasers": []}))
    assert main(["check", str(rig)]) == 2
    assert "This rig cannot measure" in capfd.readouterr().out
    assert "missing.yaml" in refused("check", tmp_path / "missing.yaml")


def commands(group, name=()):
    """Yield every command with the words that call it."""
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*name, word))
        else:
            yield (*name, word), command


ALL = dict(commands(typer.main.get_command(cli.app)))


def test_every_command_checks_its_values():
    assert len(ALL) >= 20
    assert all(isinstance(command, CheckedCommand) for command in ALL.values())


NUMBERS = [
    (words, option)
    for words, command in ALL.items()
    for option in command.params
    if option.param_type_name == "option" and isinstance(option.default, float)
]


@pytest.mark.parametrize(
    ("words", "option"), NUMBERS, ids=lambda one: str(getattr(one, "name", one))
)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_numbers_that_are_not_finite_are_refused(words, option, value, refused, tmp_path):
    """Before anything else is looked at: required values are there, but stand for nothing."""
    arguments = [*words]
    for other in ALL[words].params:
        if other.required:
            nothing = str(tmp_path / "nothing")
            arguments += (
                [other.opts[0], nothing] if other.param_type_name == "option" else [nothing]
            )
    name = max(option.opts, key=len)
    said = refused(*arguments, f"{name}={value}")
    assert said == f"{name} {value}: give a finite number" or "board" in words


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: os.symlink("/dev/zero", path)])
def test_pipes_and_devices_are_refused(make, tmp_path, refused):
    odd = tmp_path / "odd"
    make(odd)
    rig = rig_file(tmp_path)
    for arguments in (
        ["check", odd],
        ["check", rig, "--against", odd],
        ["run", odd, "--rig", rig, "-o", tmp_path / "out"],
        ["run", rig, "--rig", odd, "-o", tmp_path / "out"],
        ["tune", "bluerov2", "-o", odd],
        ["calibrate", "camera", odd, "--board", odd, "-o", tmp_path / "rig.yaml"],
    ):
        assert refused(*arguments).startswith(f"{odd}: is a ")


@pytest.mark.parametrize("rate_hz", ["0", "nan", "99999999999"])
def test_gains_are_made_for_a_frame_rate_that_cameras_have(rate_hz, refused):
    assert refused("tune", "bluerov2", "--rate-hz", rate_hz).startswith("--rate-hz ")


def test_faults_of_the_system_are_one_line(monkeypatch, refused):
    def fail(**_):
        raise PermissionError(13, "Permission denied", "/somewhere/dive.mp4")

    monkeypatch.setattr(cli, "program", lambda: fail)
    said = "/somewhere/dive.mp4: Permission denied; change its rights, or choose another path"
    assert refused("run") == said


def aqualvs(*arguments, **more):
    command = [sys.executable, "-m", "aqualvs", *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **more)


def test_output_that_nobody_reads_ends_no_command():
    reader, writer = os.pipe()
    os.close(reader)
    process = aqualvs("simulate", "--list", stdout=writer)
    os.close(writer)
    assert process.communicate()[1] == ""
    assert process.returncode == 141


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_output_that_cannot_be_written_is_said():
    with open("/dev/full", "w") as full:
        process = aqualvs("simulate", "--list", stdout=full)
    assert "standard output: cannot be written" in process.communicate()[1]
    assert process.returncode == 2


def test_closed_standard_files_are_led_nowhere(tmp_path):
    rig = rig_file(tmp_path)
    command = f"{sys.executable} -m aqualvs check {rig} 0<&- >&- 2>&-"
    assert subprocess.run(["/bin/sh", "-c", command], check=False).returncode == 0
    command = f"{sys.executable} -m aqualvs check {tmp_path}/none 0<&- >&- 2>&-"
    assert subprocess.run(["/bin/sh", "-c", command], check=False).returncode == 2


@pytest.mark.parametrize("delay_s", [0.06, 0.1, 0.15, 0.25])
def test_ctrl_c_at_the_very_beginning_is_no_traceback(delay_s):
    """Until the program's first module is read, the complaint is the interpreter's own."""
    process = aqualvs("check", "none", stdout=subprocess.PIPE)
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    read = set(re.findall(r'File ".*[/\\]aqualvs[/\\](.*)", line', said))
    assert read <= {"__init__.py", "__main__.py"}
    assert process.returncode in (2, 130, -signal.SIGINT, 1)


def test_a_fault_is_one_line_whatever_the_file_is_called(tmp_path, refused):
    error = refused("check", tmp_path / "rig\nof\x1b[31mmine.yaml")
    assert "rig\\nof\\x1b[31mmine.yaml: no such file" in error


def test_a_fault_with_a_huge_value_stays_short(tmp_path, refused):
    path = tmp_path / "rig.yaml"
    path.write_text(f"aqualvs_rig: 1\nname: {'x' * 100_000}\nimage: {'y' * 100_000}\n")
    (tmp_path / "plan.yaml").write_text(f"aqualvs_plan: {'y' * 100_000}\n")
    said = refused("check", path), refused("follow", "--sim", "--plan", tmp_path / "plan.yaml")
    assert max(map(len, said)) < 2500
    assert "plan.yaml: aqualvs_plan is 'yyy" in said[1]


def test_a_report_prints_the_errors_that_its_page_shows(tmp_path, capsys):
    dive = make_dive(tmp_path / "run", video=False)
    assert main(["report", str(dive.folder), "--truth", str(write_truth(dive, bias_mm=2.0))]) == 0
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "against the truth in 31 frames (9 with truth but without posture):"
    assert last == f"report: {dive.folder / 'report.html'}"
    empty = tmp_path / "empty.csv"
    empty.write_text("frame,range_mm,pitch_deg,yaw_deg\n0,,,\n")
    assert main(["report", str(dive.folder), "--truth", str(empty)]) == 0
    assert "it states no posture in any of its frames" in capsys.readouterr().out
