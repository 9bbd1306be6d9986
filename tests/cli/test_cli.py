"""The command line as a whole: help, version, and how fast it is there."""

import subprocess
import sys

import pytest
import yaml

from aqualvs import __version__
from aqualvs.app import cli
from aqualvs.app.cli import main
from aqualvs.errors import AqualvsError
from shell_cases import rig_file

COMMANDS = ("run", "simulate", "demo", "check", "report", "board")
HEAVY = {"numpy", "numba", "cv2", "av", "pydantic", "pyarrow", "plotly", "scipy", "rich", "yaml"}


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


def test_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"aqualvs {__version__}\n"


def test_faults_of_the_user_become_one_line(monkeypatch, capsys):
    def fail(**_):
        raise AqualvsError("dive.mp4: odd; mend it")

    monkeypatch.setattr(cli, "app", fail)
    assert main(["run"]) == 2
    said = capsys.readouterr()
    assert said.err == "aqualvs: error: dive.mp4: odd; mend it\n"
    assert said.out == ""


def test_an_interrupted_command_exits_with_130(monkeypatch, capsys):
    def interrupt(**_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", interrupt)
    assert main(["simulate"]) == 130
    assert capsys.readouterr().err == "aqualvs: error: interrupted\n"


def test_faults_of_the_program_are_not_hidden(monkeypatch):
    def fail(**_):
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(ZeroDivisionError):
        main(["run"])


def test_a_report_needs_a_run(tmp_path, capsys):
    assert main(["report", str(tmp_path / "missing")]) == 2
    assert "holds no run" in capsys.readouterr().err


def test_check_tells_a_sane_rig_from_a_useless_one(tmp_path, capsys):
    rig = rig_file(tmp_path)
    assert main(["check", str(rig)]) == 0
    assert "This rig is sane" in capsys.readouterr().out
    content = yaml.safe_load(rig.read_text())
    rig.write_text(yaml.safe_dump({**content, "lasers": []}))
    assert main(["check", str(rig)]) == 2
    assert "This rig cannot measure" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "missing.yaml")]) == 2
    assert "missing.yaml" in capsys.readouterr().err


def test_a_fault_is_one_line_whatever_the_file_is_called(tmp_path, capsys):
    assert main(["check", str(tmp_path / "rig\nof\x1b[31mmine.yaml")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "rig\\nof\\x1b[31mmine.yaml: no such file" in error
